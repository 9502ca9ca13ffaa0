"""Real hulls are watertight and manifold, at edges and at vertices, however they are carved."""

from __future__ import annotations

import numpy as np
import pytest

from capture.layouts import dome_layout
from capture.rig import Rig
from hull.cleaning import is_closed
from hull.visual_hull import HullOptions, build_hull
from tests.hull_subjects import figure, is_vertex_manifold


def _spoilt(rig: Rig) -> list[np.ndarray]:
    images = figure().silhouettes(rig)
    images[3] = np.roll(images[3], 12, axis=1)
    images[5][200:] = 0
    return images


def _cropped(rig: Rig) -> list[np.ndarray]:
    images = figure().silhouettes(rig)
    for image in images[::2]:
        image[image.shape[0] // 2 :] = 128
    return images


HULLS = {
    "plain": (lambda rig: figure().silhouettes(rig), HullOptions()),
    "faults": (_spoilt, HullOptions()),
    "faults not looked for": (_spoilt, HullOptions(find_faults=False)),
    "cropped": (_cropped, HullOptions()),
    "votes": (lambda rig: figure().silhouettes(rig), HullOptions(votes=2)),
    "soft": (lambda rig: figure().silhouettes(rig), HullOptions(soft=True)),
    "refine": (lambda rig: figure().silhouettes(rig), HullOptions(refine=True)),
}


@pytest.mark.parametrize("name", HULLS)
def test_hulls_are_watertight_and_manifold_at_edges_and_vertices(name: str) -> None:
    images_of, options = HULLS[name]
    rig = dome_layout(12, (320, 320))
    for voxel_m in (0.024, 0.013):
        hull = build_hull(rig, images_of(rig), voxel_m, options=options)
        assert is_closed(hull.faces, len(hull.vertices))
        assert is_vertex_manifold(hull.faces, len(hull.vertices))
        assert np.isfinite(hull.vertices).all()


def test_two_cones_that_share_a_tip_are_not_manifold() -> None:
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert is_vertex_manifold(tetrahedron, 4)
    other = np.where(tetrahedron == 0, 0, tetrahedron + 3)
    both = np.vstack([tetrahedron, other])
    assert is_closed(both, 7)
    assert not is_vertex_manifold(both, 7)
