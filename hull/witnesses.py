"""Who has seen a place: enough cameras, from directions different enough, or it does not count as inside.

A camera gives no evidence about what lies outside its picture, behind it, or under an unknown pixel. If that
alone decided, all space that no picture shows would count as inside; so a place needs witnesses (reference,
section 6d).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, UInt64

from hull.errors import HullError
from hull.tables import SilhouetteTable

MIN_WITNESSES = 3
MIN_SPREAD_DEG = 90.0
WORD_BITS = 64


@dataclass(frozen=True, eq=False)
class WitnessRule:
    """Decides whether a set of cameras (rows of bits, 64 a word) is enough to say "inside".

    Fields
    ------
    n_cameras : tables in use; bit k of word k // 64 is the k-th of them.
    n_min : cameras needed.
    spread_rad : some two of them must look along directions this far apart.
    angles_rad : (C C) angle between the cameras' directions from the subject.
    """

    n_cameras: int
    n_min: int
    spread_rad: float
    angles_rad: Float[np.ndarray, "c c"]

    def full(self) -> UInt64[np.ndarray, " w"]:
        """The set of all cameras, one row of words."""
        return packed(np.ones(self.n_cameras, dtype=bool))

    @cached_property
    def _far_sets(self) -> tuple[UInt64[np.ndarray, " w"], ...]:
        """For each camera the set of those that look from a direction different enough."""
        return tuple(packed(row) for row in self.angles_rad >= self.spread_rad)

    def enough(self, sets: UInt64[np.ndarray, "w n"]) -> Bool[np.ndarray, " n"]:
        """For each column of `sets` (W N): is it enough?"""
        count = np.bitwise_count(sets).sum(axis=0, dtype=np.int64)
        far = self.angles_rad >= self.spread_rad
        # More cameras than any one of them has near it cannot all be near each other.
        verdict = count > max(int((~far).sum(axis=1).max()), self.n_min - 1)
        open_ = np.flatnonzero(~verdict & (count >= self.n_min))
        for camera in range(self.n_cameras):
            if not len(open_):
                break
            word, bit = camera // WORD_BITS, np.uint64(1) << np.uint64(camera % WORD_BITS)
            has_it = (sets[word, open_] & bit) != 0
            has_far = (sets[:, open_] & self._far_sets[camera][:, None]).any(axis=0)
            verdict[open_[has_it & has_far]] = True
            open_ = open_[~(has_it & has_far)]
        return verdict


def packed(members: Bool[np.ndarray, " c"]) -> UInt64[np.ndarray, " w"]:
    """(C,) bool -> one row of words, 64 cameras a word."""
    words = np.zeros(-(-len(members) // WORD_BITS), dtype=np.uint64)
    for k in np.flatnonzero(members):
        words[k // WORD_BITS] |= np.uint64(1) << np.uint64(k % WORD_BITS)
    return words


def witness_rule(tables: Sequence[SilhouetteTable], subject: Float[np.ndarray, " 3"]) -> WitnessRule:
    """Three witnesses over 90 degrees where the rig has them, else two over half of its widest angle.

    `subject` (3,): about where the person is, metres. Raises HullError with fewer than two silhouettes.
    """
    if len(tables) < 2:
        raise HullError(
            f"{len(tables)} of the cameras gave a silhouette; "
            "a hull needs at least 2, and 3 or more to be of use"
        )
    directions = np.array([table.centre for table in tables]) - subject
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    angles = np.arccos(np.clip(directions @ directions.T, -1.0, 1.0))
    return WitnessRule(
        n_cameras=len(tables),
        n_min=min(MIN_WITNESSES, len(tables)),
        spread_rad=min(np.deg2rad(MIN_SPREAD_DEG), 0.5 * float(angles.max())),
        angles_rad=angles,
    )
