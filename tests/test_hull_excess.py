"""What hulls stand off is told by their slack: more views, less of it; scans have none."""

import numpy as np

from capture.layouts import dome_layout
from fit.align import Alignment
from fit.hull_excess import hull_excess
from fit.settings import FitSettings
from fit.state import BodyState
from fit.thickness import Thickness, undressed
from hull.scan import Scan
from hull.slack import EXCESS_PER_M, LARGEST_EXCESS_M, expected_excess
from hull.visual_hull import build_hull
from tests.hull_subjects import figure
from tests.test_fit_pose_finding import fitter


def test_excess_grows_with_slack_and_stops_where_phantoms_begin():
    slack = np.array([0.0, 0.02, 0.03, 0.04, 0.2, 0.9])
    excess = expected_excess(slack)
    np.testing.assert_allclose(excess[:4], EXCESS_PER_M * 0.035 * slack[:4])
    assert excess[4] == excess[5] == LARGEST_EXCESS_M


def test_excess_expected_of_a_figure_is_about_what_it_is():
    subject, before = figure(), np.inf
    for n_cameras in (12, 16, 32):  # of fewer, places stand off by more than what is ever expected
        rig = dome_layout(n_cameras, (1024, 1024))
        hull = build_hull(rig, subject.silhouettes(rig), 0.016)
        true_mm = 1e3 * subject.distance(hull.vertices).mean()
        expected_mm = 1e3 * expected_excess(hull.slack_m).mean()
        told = f"{n_cameras} cameras: expected {expected_mm:.1f} mm, true {true_mm:.1f} mm"
        assert abs(expected_mm - true_mm) < 2.0, told
        assert expected_mm < before, told
        before = expected_mm


def test_over_the_body_only_hulls_have_any():
    model = fitter().model
    state = BodyState(model.template, np.zeros((24, 3)), np.zeros(3), np.zeros(model.n_betas))
    points, n = fitter().posed(state), model.n_vertices
    scan = Scan(points, np.zeros((n, 3)), None, np.zeros(n, dtype=bool), np.ones(n))
    alignments = [Alignment(k, state, 0.02, 0.002) for k in range(3)]
    assert hull_excess(fitter(), dict.fromkeys(range(3), scan), alignments) is None
    hulls = {
        k: Scan(points, scan.normals, None, scan.is_skin, scan.weight, excess_m=np.full(n, 1e-3 * (k + 1)))
        for k in range(3)
    }
    found = hull_excess(fitter(), hulls, alignments)
    assert found is not None
    np.testing.assert_allclose(found, 0.002, atol=1e-12)


def test_skin_that_is_known_stands_off_as_hulls_do_and_carries_no_cloth():
    thickness = Thickness(np.full(3, 0.02), np.full(3, 0.01), np.full(3, 0.005))
    settings = FitSettings().thickness
    bare = np.array([0.0, 0.5, 1.0])
    on_scans = undressed(thickness, bare, settings).expected
    np.testing.assert_allclose(on_scans, [0.02, 0.01, 0.0])
    on_hulls = undressed(thickness, bare, settings, np.full(3, 0.004)).expected
    np.testing.assert_allclose(on_hulls - on_scans, bare * settings.excess_shares[0] * 0.004)
