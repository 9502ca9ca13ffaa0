"""The unknowns of the single-frame objective (paper section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class BodyState:
    """One body in one frame.

    template: T_Est, the free-form vertices in the zero pose, m; pose: axis-angle a joint, rad; translation:
    m; betas: shape coefficients of M(beta, 0), standard deviations. All in the body's upright frame (y up).
    """

    template: Float[np.ndarray, "v 3"]
    pose: Float[np.ndarray, "j 3"]
    translation: Float[np.ndarray, "3"]
    betas: Float[np.ndarray, "b"]

    def moved(self, **changes: np.ndarray) -> BodyState:
        """A copy with some of the unknowns replaced."""
        return replace(self, **changes)
