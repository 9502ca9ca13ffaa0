"""How the innermost loops are compiled: to a cache where there is a place for one, else once a process."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit


def kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled, with numpy's rules for division; other threads run meanwhile."""
    return _compiled(function, fastmath=False)


def loose_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same with sums in any order: for what only steers an iteration."""
    return _compiled(function, fastmath=True)


def _compiled(function: Callable[..., Any], fastmath: bool) -> Callable[..., Any]:
    try:
        return njit(cache=True, nogil=True, error_model="numpy", fastmath=fastmath)(function)
    except RuntimeError:  # nowhere to keep it
        return njit(nogil=True, error_model="numpy", fastmath=fastmath)(function)
