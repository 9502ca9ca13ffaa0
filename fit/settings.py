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

    cloth: treat every point that is not labelled skin as cloth (outside + fit) instead of as skin; sigma_m:
    Geman-McClure scale of skin or fit; skin, outside, fit: lambda_skin, lambda_outside, lambda_fit;
    boundary_as_cloth: what g takes from a skin point near cloth counts as cloth (the paper lets it go);
    outside_m: Huber scale of the outside term;
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
    skin: float = 1.0
    outside: float = 1.0
    boundary_as_cloth: bool = True


def _fusion_stage(coupling: float) -> StageWeights:
    return StageWeights(cloth=True, sigma_m=0.02, fit=0.03, coupling=coupling, tether=1e-3, gate=False)


def _fusion_together(coupling: float) -> StageWeights:
    return StageWeights(
        cloth=True, sigma_m=0.005, fit=0.0, outside_m=0.004, coupling=coupling, tether=1e-3, gate=False
    )


def _track_pose() -> StageWeights:
    return StageWeights(cloth=True, sigma_m=0.05, fit=1.0, inside=1.0)


def _track_template() -> StageWeights:
    return StageWeights(
        cloth=True, sigma_m=0.02, fit=0.015, coupling=0.3, tether=1e-3, inside=5.0, margin_m=0.0005
    )


@dataclass(frozen=True)
class ThicknessSettings:
    """How movement of the cloth tells its thickness (`fit.thickness`).

    per_movement: factor on the ratio of thickness to deviation along the normal; excess_shares: of a
    hull's expected excess, how much an alignment stands off skin, and off cloth of folded_m or more, in whose
    folds no outline can reach; swing_m: movement whose thickness is half of what the
    ratio says; tolerance_share: how far that may be off; tolerance_m, noise_m: tolerance and deviation where
    there is no cloth; largest_movement_m: more is no cloth either; pooling_rounds: means over neighbours
    before deviations are compared.
    """

    per_movement: float = 1.0
    excess_shares: tuple[float, float] = (0.4, 1.0)
    folded_m: float = 0.01
    swing_m: float = 0.04
    tolerance_share: float = 0.4
    tolerance_m: float = 0.002
    noise_m: float = 0.001
    largest_movement_m: float = 0.03
    pooling_rounds: int = 15


@dataclass(frozen=True)
class TogetherSettings:
    """One shape and all poses at once (`fit.together`).

    n_independent: independent observations that a frame's surface is worth; outlier: residuals of so many
    tolerances count half; outside_m: how far cloth may be inside the body; shape_prior: of the betas, times
    the number of frames; pose_prior: a frame; every_vertex: only every n-th vertex is summed; shape_frames:
    at most so many frames find the betas, the first of them so that the others start near; rounds, rest: at
    most so many, until nothing moves farther, or relative_drop: until the energy changes by no more than this
    share; near: what single poses are brought to (rad).
    """

    n_independent: float = 300.0
    outlier: float = 3.0
    outside_m: float = 0.001
    shape_prior: float = 1.0
    pose_prior: float = 1.0
    every_vertex: int = 2
    first_frames: int = 12
    shape_frames: int = 40
    rounds: int = 10
    rest: float = 0.02
    relative_drop: float = 5e-3
    near: float = 0.05


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
    #: One shape and all poses at once, where the clothes' movement can be read; else the paper's fusion.
    at_once: bool = True
    thickness: ThicknessSettings = field(default_factory=ThicknessSettings)
    together: TogetherSettings = field(default_factory=TogetherSettings)
    #: Fusion shape, stiff then soft: every vertex of every unposed alignment is a cloth point.
    fuse: tuple[StageWeights, ...] = (_fusion_stage(5.0), _fusion_stage(0.1))
    #: The same where the clothes' thickness is known: the skin term holds what is expected under the cloth.
    fuse_together: tuple[StageWeights, ...] = (_fusion_together(5.0), _fusion_together(0.1))
    #: Added to the pull on the fusion shape where the skin is known best; it falls with the square of the
    #: certainty.
    sure_pull: float = 10.0
    #: Factor on lambda_fit in tracking where the skin is known best; it falls with the third power of the
    #: certainty, so that bare parts follow the scan and covered ones the fusion shape.
    sure_fit: float = 60.0
    #: Tracking. Cloth drags a pose less when it is taken as skin on all sides (fit 1, the same
    #: everywhere) than when the body hangs on its tightest regions; the template then settles with
    #: the pose held.
    track_pose: StageWeights = field(default_factory=_track_pose)
    track_template: StageWeights = field(default_factory=_track_template)
    #: lambda_skin of fusion: bare parts of unposed alignments are some millimetres off.
    fuse_skin: float = 0.3
    #: Logistic of the geodesic distance to the nearest cloth: its middle and its width.
    skin_edge_m: float = 0.03
    skin_edge_width_m: float = 0.0075
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
