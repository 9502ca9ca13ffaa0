"""The first pose from a surface alone: derivatives, right heading, raised and bent arms, keypoints."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fit.body.model import load_body
from fit.body.pose_prior import PosePrior
from fit.coarse import CoarsePose, CoarseScan, left_jacobian_inverse
from fit.initialise import PoseFinder
from fit.limb_seeds import arm_configurations, leg_configurations, stances
from fit.solver import Fitter
from fit.state import BodyState
from hull.scan import even_samples


@cache
def fitter() -> Fitter:
    return Fitter.of(load_body("free:neutral", show_progress=False))


@cache
def finder() -> PoseFinder:
    return PoseFinder.of(fitter().model, PosePrior.standard())


def scanned(pose: np.ndarray, first_beta: float = 0.0, n_points: int = 6000) -> tuple[CoarseScan, np.ndarray]:
    """A scan of the bare model in a pose, and its posed joints."""
    model = fitter().model
    betas = np.zeros(model.shape_directions.shape[2])
    betas[0] = first_beta
    state = BodyState(fitter().shaped(betas), pose, np.array([0.4, 1.0, -0.3]), betas)
    vertices, joints = fitter().posed(state), fitter().joints(betas)
    face_idx, bary = even_samples(vertices, model.faces, n_points, 3)
    corners = vertices[model.faces[face_idx]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.einsum("nk,nki->ni", bary, corners)
    return CoarseScan.of(points, normals), fitter().posed_joints(state, joints)


def joints_of(at: CoarsePose) -> np.ndarray:
    posed = finder().body.forward(at)
    return posed.origin


def test_coarse_derivatives_against_differences():
    body = finder().body
    rng = np.random.default_rng(0)
    at = CoarsePose(0.4 * rng.normal(size=(24, 3)), rng.normal(size=3), np.zeros(finder().n_model_betas))
    posed = body.forward(at)
    jacobian = body.jacobian(posed)
    h = 1e-6
    for column in (0, 4, 17, 50, 60, 72, 74, 75, 78):
        step = np.zeros(jacobian.shape[2])
        step[column] = h
        pose = (Rotation.from_rotvec(step[:72].reshape(-1, 3)) * Rotation.from_rotvec(at.pose)).as_rotvec()
        betas = at.betas.copy()
        betas[: body.n_betas] += step[75:]
        moved = body.forward(CoarsePose(pose, at.translation + step[72:75], betas)).points
        np.testing.assert_allclose((moved - posed.points) / h, jacobian[:, :, column], atol=5e-6)


def test_left_jacobian_inverse_against_differences():
    vector = np.array([[0.3, -0.8, 0.5], [1e-9, 0.0, 0.0]])
    small = 1e-6 * np.array([[0.2, 0.5, -0.4], [0.2, 0.5, -0.4]])
    moved = (Rotation.from_rotvec(small) * Rotation.from_rotvec(vector)).as_rotvec()
    predicted = np.einsum("nab,nb->na", left_jacobian_inverse(vector), small)
    np.testing.assert_allclose(moved - vector, predicted, atol=1e-11)


@pytest.mark.parametrize("heading_deg", [20.0, 160.0, -95.0])
def test_heading_is_found_without_a_flip(heading_deg):
    pose = finder().mean_pose()
    pose[0] = [0.0, np.radians(heading_deg), 0.0]
    pose[[1, 4]] = [[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]
    scan, joints = scanned(pose, first_beta=1.5)
    best = finder().from_hull(scan)[0]
    error = np.linalg.norm(joints_of(best) - joints, axis=1)
    assert error.mean() < 0.045, f"joints are {1e3 * error.mean():.0f} mm off on average"
    assert error.max() < 0.15, f"the worst joint is {1e3 * error.max():.0f} mm off"


@pytest.mark.parametrize("arm", ["up", "front", "bent"])
def test_arms_are_found_wherever_they_are(arm):
    left, _ = arm_configurations()
    pose = finder().mean_pose()
    rows = {"up": 10, "front": 7, "bent": 1}
    for side, joints in enumerate(((13, 16, 18, 20), (14, 17, 19, 21))):
        pose[list(joints)] = left[rows[arm]] * (np.array([1, -1, -1]) if side else 1)
    scan, joints = scanned(pose)
    best = finder().from_hull(scan)[0]
    error = np.linalg.norm(joints_of(best) - joints, axis=1)
    assert error[[18, 19, 20, 21]].max() < 0.12, (
        f"elbows and wrists are off by {1e3 * error[18:22].round(3)} mm"
    )


@pytest.mark.parametrize("low", ["sits, hands on the head", "kneels"])
def test_people_near_the_ground_are_found(low):
    """A standing child with its legs in the ground would fit the heights, too."""
    pose = stances(finder().mean_pose())[1]
    if low == "kneels":
        pose[[1, 4]], pose[[2, 5]] = [[-1.4, 0, 0], [1.5, 0, 0]], [[0.0, 0, 0], [1.6, 0, 0]]
    else:
        for shoulder, elbow, mirror in ((16, 18, 1.0), (17, 19, -1.0)):
            pose[shoulder], pose[elbow] = [-1.3, 0.3 * mirror, 0.4 * mirror], [0, -2.2 * mirror, 0]
    pose[0] = [0.0, 2.3, 0.0]
    scan, joints = scanned(pose)
    best = finder().from_hull(scan)[0]
    error = np.linalg.norm(joints_of(best) - joints, axis=1)
    assert error.mean() < 0.045, f"joints are {1e3 * error.mean():.0f} mm off on average"
    assert error.max() < 0.15, f"the worst joint is {1e3 * error.max():.0f} mm off"


def test_limbs_are_tried_alike_on_both_sides():
    for left, right in (arm_configurations(), leg_configurations()):
        np.testing.assert_allclose(left * [1, -1, -1], right)


def test_the_prior_gives_way_as_the_pose_gets_near():
    prior = finder().prior
    assert prior.weight_at(0.3) == prior.weight_at(0.15) == prior.pose_weight
    assert prior.weight_at(0.05) == pytest.approx(prior.pose_weight / 9)
    assert prior.weight_at(0.05, doubt=1.0) == prior.pose_weight


def test_a_loose_hull_is_doubtful():
    points = np.random.default_rng(0).normal(size=(50, 3))
    even, uneven = np.ones(50), np.where(np.arange(50) % 2, 1.5, 0.5)
    assert CoarseScan.of(points, points, weight=even).doubt == CoarseScan.of(points, points).doubt == 0.0
    assert CoarseScan.of(points, points, weight=uneven).doubt == 1.0


def test_keypoints_with_gaps_give_the_pose():
    pose = finder().mean_pose()
    pose[0] = [0.0, 2.0, 0.0]
    scan, joints = scanned(pose)
    model = fitter().model
    betas = np.zeros(model.shape_directions.shape[2])
    state = BodyState(fitter().shaped(betas), pose, np.array([0.4, 1.0, -0.3]), betas)
    keypoints = np.concatenate([model.landmarks @ fitter().posed(state), np.ones((25, 1))], axis=1)
    keypoints[[3, 15, 22]] = np.nan
    found = finder().from_keypoints(scan, keypoints)
    assert found is not None
    error = np.linalg.norm(joints_of(found) - joints, axis=1)
    assert error.mean() < 0.03, f"joints are {1e3 * error.mean():.0f} mm off on average"


def test_too_few_keypoints_are_refused():
    scan, _ = scanned(finder().mean_pose())
    keypoints = np.full((25, 4), np.nan)
    keypoints[:4] = 1.0
    assert finder().from_keypoints(scan, keypoints) is None
