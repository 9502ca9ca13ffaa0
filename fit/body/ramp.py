"""The one soft step that the generator's places are faded in and out with."""

import numpy as np
from jaxtyping import Float


def smooth_step(low: float, high: float, t: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """0 below `low`, 1 above `high` (or the reverse when low > high), with flat ends."""
    x = np.clip((t - low) / (high - low), 0, 1)
    return x * x * (3 - 2 * x)
