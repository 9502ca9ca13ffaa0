"""The paper's lambdas under their names, and its two sets of numbers (section 6).

E = lambda_skin E_skin + lambda_outside E_outside + lambda_fit E_fit + lambda_cpl E_cpl + lambda_prior E_prior
(+ lambda_shape |beta|^2). The paper leaves open what the sums are. Here (`energy.py`): metres; E_skin,
E_outside and
E_fit are means over the scan's points times the number of the body's vertices; E_cpl is a sum over its edges;
Geman-McClure is d^2 near zero. Only ratios of lambdas matter, so the paper's 100, 100, 3, 1 are 1, 1, 0.03,
0.01.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from fit.settings import FitSettings, StageWeights


@dataclass(frozen=True)
class Lambdas:
    """Weights that replace those of `FitSettings`; None leaves one as it is.

    cpl is also the end of the fusion, which starts stiffer. fit is that of fusion and detail: the tracked
    pose takes cloth as skin. With fit or skin given, the paper's fusion is made, whose weights they are.
    """

    skin: float | None = None
    outside: float | None = None
    fit: float | None = None
    cpl: float | None = None
    prior: float | None = None
    shape: float | None = None


PRESETS = {
    "buff": Lambdas(skin=1.0, outside=1.0, fit=0.03, cpl=0.01),
    "inria": Lambdas(skin=1.0, outside=1.0, fit=0.01, cpl=0.01),
}


def with_lambdas(settings: FitSettings, lambdas: Lambdas) -> FitSettings:
    """The settings with these weights in every stage that has the term. Raises ValueError for negative
    ones."""
    for name, value in vars(lambdas).items():
        if value is not None and not 0.0 <= value < float("inf"):
            raise ValueError(f"--lambda-{name} {value:g}: weights are 0 or more")

    def changed(stage: StageWeights, fit: bool = True, cpl: bool = True) -> StageWeights:
        given = {
            "skin": lambdas.skin,
            "outside": lambdas.outside if stage.cloth else None,
            "fit": lambdas.fit if stage.cloth and fit else None,
            "coupling": lambdas.cpl if cpl else None,
            "pose_prior": lambdas.prior,
            "shape_prior": lambdas.shape,
        }
        chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        return replace(stage, **chosen)

    *first, last = settings.fuse
    of_fusion = lambdas.fit is not None or lambdas.skin is not None
    return replace(
        settings,
        at_once=settings.at_once and not of_fusion,
        align_pose=tuple(changed(s, cpl=False) for s in settings.align_pose),
        align_joint=tuple(changed(s) for s in settings.align_joint),
        fuse=(*(changed(s, cpl=False) for s in first), changed(last)),
        track_pose=changed(settings.track_pose, fit=False, cpl=False),
        track_template=changed(settings.track_template),
    )


def preset(name: str, settings: FitSettings | None = None) -> FitSettings:
    """The paper's own objective: its lambdas, the square outside, one lambda_fit for all regions, nothing
    that hulls know, skin that ends at its edge. Raises KeyError for an unknown name."""
    found = with_lambdas(FitSettings() if settings is None else settings, PRESETS[name])

    def plain(stage: StageWeights) -> StageWeights:
        return replace(stage, outside_m=float("inf"), inside=0.0, boundary_as_cloth=False)

    return replace(
        found,
        fuse=tuple(plain(s) for s in found.fuse),
        track_pose=replace(plain(found.track_pose), fit=PRESETS[name].fit or 0.0),
        track_template=plain(found.track_template),
        spread_power=0.0,
        fuse_skin=1.0,
    )
