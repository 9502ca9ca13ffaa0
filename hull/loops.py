"""The compiled loops, where there are any. Imported when first asked for, because that starts a compiler."""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType


@lru_cache(maxsize=1)
def table_loops() -> ModuleType | None:
    """`hull.compiled`; None without numba: then the plain definitions do."""
    try:
        from hull import compiled
    except ImportError:
        return None
    return compiled


@lru_cache(maxsize=1)
def mesh_loops() -> ModuleType | None:
    """`hull.compiled_mesh`, likewise."""
    try:
        from hull import compiled_mesh
    except ImportError:
        return None
    return compiled_mesh
