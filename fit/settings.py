"""Every weight of the three stages, in one place and with its reason.

Names are the paper's lambdas; `energy.py` tells the normalisation. The paper's numbers (100, 100, 3, 1
with plain sums) do not carry over: here outside has weight 1 a point and the sums are means times the
number of vertices.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class StageWeights:
    """One objective: which terms, how strong.

    cloth: treat every point as cloth (outside + fit) instead of as skin; sigma_m: Geman-McClure scale
    of skin or fit; fit: lambda_fit / lambda_outside; outside_m: Huber scale of the outside term;
    inside, inside_m, margin_m: weight a vertex, Huber scale and depth to reach of keeping the body
    inside a closed scan; coupling: lambda_cpl; tether: absolute pull of the template to its target;
    pose_prior, shape_prior: of the Gaussian priors; gate: whether points facing away from the body's
    surface are ignored.
    """

    cloth: bool
    sigma_m: float
    fit: float = 0.0
    outside_m: float = 0.006
    inside: float = 0.0
    inside_m: float = 0.01
    margin_m: float = 0.0
    coupling: float = 0.0
    tether: float = 0.0
    pose_prior: float = 1e-3
    shape_prior: float = 1e-3
    gate: bool = True


def _fusion_stage(coupling: float) -> StageWeights:
    return StageWeights(cloth=True, sigma_m=0.02, fit=0.03, coupling=coupling, tether=1e-3, gate=False)


def _track_pose() -> StageWeights:
    return StageWeights(cloth=True, sigma_m=0.05, fit=1.0, inside=1.0)


def _track_template() -> StageWeights:
    return StageWeights(
        cloth=True, sigma_m=0.02, fit=0.015, coupling=0.3, tether=1e-3, inside=5.0, margin_m=0.0005
    )


@dataclass(frozen=True)
class FitSettings:
    """The stages in order (paper sections 4.1 to 4.3) and the sizes of the problem."""

    n_points: int = 12_000
    seed: int = 0
    #: Cloth alignments: pose and shape alone, then the template joins them. A wider first sigma
    #: and a stiffer first coupling were tried: same result, twice the time, since the pose finder
    #: leaves centimetres at most.
    align_pose: tuple[StageWeights, ...] = (StageWeights(cloth=False, sigma_m=0.05),)
    #: The pose alone moves with only so many of the first coefficients (measured and named ones of the
    #: free body): the smooth ones would follow folds before the limbs lie right, and cost time.
    pose_betas: int = 68
    align_joint: tuple[StageWeights, ...] = (
        StageWeights(cloth=False, sigma_m=0.05, coupling=1.0, tether=1e-2),
    )
    #: Fusion shape, stiff then soft: every vertex of every unposed alignment is a cloth point.
    fuse: tuple[StageWeights, ...] = (_fusion_stage(5.0), _fusion_stage(0.1))
    #: Tracking. Cloth drags a pose less when it is taken as skin on all sides (fit 1, the same
    #: everywhere) than when the body hangs on its tightest regions; the template then settles with
    #: the pose held.
    track_pose: StageWeights = field(default_factory=_track_pose)
    track_template: StageWeights = field(default_factory=_track_template)
    #: lambda_fit is multiplied by (spread_m / spread)^spread_power a vertex, within these limits.
    spread_m: float = 0.0025
    spread_power: float = 3.0
    spread_rounds: int = 15
    fit_scale_limits: tuple[float, float] = (0.01, 20.0)
    #: Up to this mean distance of scans to alignments the spread is cloth; this far beyond, half
    #: of it is not.
    trusted_distance_m: float = 0.0035
    doubt_m: float = 0.002
    #: Factor on lambda_fit (and twice the sigma) where the spread is not to be trusted at all.
    doubtful_fit: float = 100.0
    #: Factor on lambda_cpl and on the shape prior there: phantom volume must not become lumps of the body,
    #: nor a hunch.
    doubtful_coupling: float = 500.0
    max_iterations: int = 15
    relative_drop: float = 1e-2

    def stiffness(self, trust: float) -> float:
        """Factor on lambda_cpl and the shape prior for hulls that are trusted this far."""
        return float(self.doubtful_coupling ** ((1.0 - trust) ** 2))
