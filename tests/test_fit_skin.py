"""Skin and cloth: geodesic distance and g against closed forms, labels by colour on a known surface, the
skin term."""

import numpy as np
import pytest

from fit import energy as terms
from fit.evaluate import Surface, mean_penetration, penetration
from fit.geodesic import distance_from
from fit.presets import PRESETS, Lambdas, preset, with_lambdas
from fit.settings import FitSettings
from fit.skin import edges_of
from hull.skin_colour import is_skin_tone, lab, skin_by_colour

SKIN, CLOTH, HAIR = (226, 178, 148), (70, 100, 180), (28, 26, 28)


def tube(n_around: int = 48, n_along: int = 40, radius_m: float = 0.1, length_m: float = 0.8):
    """Vertices and faces of an open tube along z."""
    angle = 2 * np.pi * np.arange(n_around) / n_around
    z = np.linspace(0, length_m, n_along)
    vertices = np.stack(
        [
            np.tile(radius_m * np.cos(angle), n_along),
            np.tile(radius_m * np.sin(angle), n_along),
            np.repeat(z, n_around),
        ],
        axis=1,
    )
    faces = []
    for row in range(n_along - 1):
        for k in range(n_around):
            a, b = row * n_around + k, row * n_around + (k + 1) % n_around
            faces += [[a, b, b + n_around], [a, b + n_around, a + n_around]]
    return vertices, np.array(faces)


def test_distance_along_a_tube() -> None:
    vertices, faces = tube()
    far = distance_from(vertices, faces, vertices[:, 2] < 1e-9)
    assert np.abs(far - vertices[:, 2]).max() < 1e-6, "straight up the tube"
    one = np.zeros(len(vertices), dtype=bool)
    one[0] = True
    around = np.abs(np.arctan2(vertices[:, 1], vertices[:, 0])) * 0.1
    exact = np.hypot(around, vertices[:, 2])
    found = distance_from(vertices, faces, one)
    # Paths along edges and across pairs of triangles: a little long, in the worst direction an eighth.
    ratio = found[1:] / exact[1:]
    assert ratio.min() > 0.99 and ratio.max() < 1.15 and np.percentile(ratio, 90) < 1.06
    assert np.isinf(distance_from(vertices, faces, np.zeros(len(vertices), dtype=bool))).all()


def test_g_is_the_logistic_of_the_paper() -> None:
    g = terms.skin_share(np.array([0.0, 0.03, 0.0375, 1.0, np.inf]), 0.03, 0.0075)
    assert g[0] == 0.0 and g[1] == 0.5 and g[4] == pytest.approx(1.0)
    assert g[2] == pytest.approx(1 / (1 + np.exp(-1.0)))
    energy, weight = terms.skin(np.array([0.01, -0.01]), 0.05, np.array([0.5, 1.0]))
    assert energy[0] == pytest.approx(0.5 * energy[1]) and weight[0] == pytest.approx(0.5 * weight[1])


def test_cloth_is_outside_and_fit() -> None:
    d = np.array([-0.02, -0.001, 0.0, 0.01])
    energy, weight = terms.cloth(d, 2.0, 0.006, 0.5, 0.02)
    out, fit = terms.outside(d, 0.006), terms.fit(d, 0.02)
    assert np.allclose(energy, 2 * out[0] + 0.5 * fit[0]) and np.allclose(weight, 2 * out[1] + 0.5 * fit[1])
    square = terms.outside(d, np.inf)
    assert np.allclose(square[0], np.where(d < 0, d**2, 0.0)), "the paper's square"


def coloured_tube(skin: tuple[int, int, int], cloth: tuple[int, int, int]):
    """Four frames of a tube: bare from 0.5 m up, hair at the tip; noise, shade, and an edge that slides."""
    vertices, faces = tube()
    random = np.random.default_rng(2)
    edge = 0.5 + np.array([0.0, 0.02, 0.04, 0.02])
    truth = vertices[:, 2] > edge[:, None]
    colours = np.where(truth[:, :, None], skin, cloth).astype(float)
    colours[:, vertices[:, 2] > 0.74] = HAIR
    shade = 0.8 + 0.2 * np.cos(np.arctan2(vertices[:, 1], vertices[:, 0]))
    colours = colours * shade[:, None] + random.normal(0, 8, colours.shape)
    speckled = random.random(truth.shape) < 0.03
    colours[speckled] = random.integers(0, 255, (speckled.sum(), 3))
    return np.clip(colours, 0, 255).astype(np.uint8), truth & (vertices[:, 2] <= 0.74), vertices, faces


@pytest.mark.parametrize("skin", [SKIN, (96, 62, 48)])
def test_skin_is_told_by_colour(skin: tuple[int, int, int]) -> None:
    colours, truth, vertices, faces = coloured_tube(skin, CLOTH)
    seed = (vertices[:, 2] > 0.62) & (vertices[:, 2] < 0.72)
    gloves = vertices[:, 2] < 0.05
    found = skin_by_colour(colours, [seed, gloves], edges_of(faces))
    assert found is not None
    assert (found == truth).mean() > 0.98, f"{100 * (found != truth).mean():.1f} % wrong"


def test_no_bare_place_no_skin() -> None:
    colours, _, vertices, faces = coloured_tube(CLOTH, CLOTH)
    assert skin_by_colour(colours, [vertices[:, 2] > 0.6], edges_of(faces)) is None
    for rgb, bare in ((SKIN, True), ((60, 40, 32), True), (CLOTH, False), ((128, 128, 128), False)):
        assert is_skin_tone(lab(np.array([rgb], dtype=np.uint8))[0]) == bare, rgb


def test_lambdas_reach_every_stage_that_has_the_term() -> None:
    usual = FitSettings()
    assert with_lambdas(usual, Lambdas()) == usual
    changed = with_lambdas(usual, Lambdas(skin=2.0, outside=3.0, fit=4.0, cpl=5.0, prior=6.0, shape=7.0))
    stages = (*changed.align_pose, *changed.align_joint, *changed.fuse, changed.track_template)
    assert {s.skin for s in stages} == {2.0} and {s.pose_prior for s in stages} == {6.0}
    assert {s.shape_prior for s in stages} == {7.0}
    assert {s.outside for s in stages if s.cloth} == {3.0} and {s.fit for s in stages if s.cloth} == {4.0}
    assert changed.fuse[-1].coupling == changed.align_joint[-1].coupling == 5.0
    assert (
        changed.fuse[0].coupling == usual.fuse[0].coupling and changed.track_pose.fit == usual.track_pose.fit
    )
    with pytest.raises(ValueError, match=r"--lambda-fit -1: weights are 0 or more"):
        with_lambdas(usual, Lambdas(fit=-1.0))


def test_presets_keep_the_papers_ratios() -> None:
    for name, fit in (("buff", 3.0), ("inria", 1.0)):
        last = preset(name).fuse[-1]
        assert 100 * last.fit / last.outside == pytest.approx(fit)
        assert 100 * last.coupling / last.outside == pytest.approx(1.0) and last.skin == last.outside
        assert np.isinf(last.outside_m) and not preset(name).at_once
    assert set(PRESETS) == {"buff", "inria"}


def test_penetration_of_a_known_depth() -> None:
    vertices, faces = tube(96, 60)
    body = Surface(vertices, faces)
    angle, z = np.random.default_rng(0).uniform([0, 0.1], [2 * np.pi, 0.7], (4000, 2)).T
    radius = np.where(np.arange(4000) < 1000, 0.096, 0.11)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    found = penetration(points, body)
    assert found.share == 0.25 and found.mean_mm == pytest.approx(4.0, abs=0.1)
    assert found.p95_mm == pytest.approx(4.0, abs=0.1)
    free = penetration(points[1000:], body)
    assert (free.share, free.mean_mm) == (0.0, 0.0)
    both = mean_penetration([found, free])
    assert both.share == 0.125 and both.mean_mm == found.mean_mm
