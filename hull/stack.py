"""Tables side by side, as the compiled loops of `hull.compiled` want them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from jaxtyping import Float, Int

from hull.loops import table_loops
from hull.tables import SilhouetteTable


@dataclass(frozen=True, eq=False)
class TableStack:
    """The tables' numbers and addresses. Holds the tables, so that what lies at the addresses stays there.

    Fields
    ------
    loops : the module `hull.compiled`.
    tables : in order; C of them.
    numbers : (C _) sizes, limits and addresses, in the order of the columns in `hull.compiled`.
    projections : (C 3 4), px from world.
    """

    loops: ModuleType
    tables: tuple[SilhouetteTable, ...]
    numbers: Int[np.ndarray, "c _"]
    projections: Float[np.ndarray, "c 3 4"]


def stacked(tables: Sequence[SilhouetteTable]) -> TableStack | None:
    """The stack of these tables; None where the plain definitions must do: without numba, or for tables that
    answer in a way of their own."""
    loops = table_loops()
    if loops is None or not tables or any(type(table) is not SilhouetteTable for table in tables):
        return None
    return TableStack(
        loops,
        tuple(tables),
        np.array([table.numbers for table in tables], dtype=np.int64),
        np.array([table.projection for table in tables]),
    )
