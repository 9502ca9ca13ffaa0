"""The pose prior: symmetric, within the joints' ranges, knees and elbows one way, replaceable by a file."""

from pathlib import Path

import numpy as np
import pytest

from fit.body.pose_prior import RANGES_DEG, PosePrior, mirror_angles
from fit.body.skeleton import JOINT, JOINT_NAMES


@pytest.fixture(scope="module")
def prior() -> PosePrior:
    return PosePrior.standard()


def angle(name: str, axis: int) -> int:
    return 3 * (JOINT[name] - 1) + axis


def test_every_left_and_middle_joint_has_ranges_that_hold_their_mean() -> None:
    wanted = {name for name in JOINT_NAMES[1:] if not name.startswith("right_")}
    assert set(RANGES_DEG) == wanted
    for name, axes in RANGES_DEG.items():
        for low, high, mean, sd in axes:
            assert low <= mean <= high, name
            assert 0 < sd <= (high - low) / 2, name


def test_it_is_a_proper_gaussian(prior: PosePrior) -> None:
    assert prior.mean.shape == (69,)
    np.testing.assert_array_equal(prior.covariance, prior.covariance.T)
    assert np.linalg.eigvalsh(prior.covariance).min() > 1e-5
    np.testing.assert_allclose(prior.precision @ prior.covariance, np.eye(69), atol=1e-8)
    white = prior.whitening
    np.testing.assert_allclose(white @ prior.covariance @ white.T, np.eye(69), atol=1e-8)
    np.testing.assert_allclose(white.T @ white, prior.precision, rtol=1e-6, atol=1e-6)


def test_left_and_right_are_equal(prior: PosePrior) -> None:
    np.testing.assert_allclose(mirror_angles(prior.mean), prior.mean, atol=1e-12)
    mirror = mirror_angles(np.eye(69))
    np.testing.assert_allclose(mirror @ prior.covariance @ mirror.T, prior.covariance, atol=1e-12)


def test_samples_stay_in_range_and_knees_bend_one_way(prior: PosePrior) -> None:
    samples = prior.sample(4000, seed=1)
    assert (samples >= prior.low).all()
    assert (samples <= prior.high).all()
    for side, sign in (("left", 1), ("right", -1)):
        assert samples[:, angle(f"{side}_knee", 0)].min() >= 0
        assert (sign * samples[:, angle(f"{side}_elbow", 1)]).max() <= 0
    # The clipping must not move the whole distribution.
    spread = samples.std(0) / np.sqrt(np.diag(prior.covariance))
    assert spread.min() > 0.75
    assert np.abs(samples.mean(0) - prior.mean).max() < 0.1


def test_arms_hang_and_legs_stand(prior: PosePrior) -> None:
    assert np.degrees(prior.mean[angle("left_shoulder", 2)]) == pytest.approx(-60, abs=10)
    assert np.degrees(prior.mean[angle("right_shoulder", 2)]) == pytest.approx(60, abs=10)
    hip, knee, ankle = (prior.mean[angle(f"left_{name}", 0)] for name in ("hip", "knee", "ankle"))
    assert abs(np.degrees(hip + knee + ankle)) < 15  # the sole is near level


def test_couplings_have_the_sign_of_the_body(prior: PosePrior) -> None:
    sd = np.sqrt(np.diag(prior.covariance))
    correlation = prior.covariance / np.outer(sd, sd)
    assert correlation[angle("left_hip", 0), angle("left_knee", 0)] < -0.4
    assert correlation[angle("left_hip", 0), angle("right_hip", 0)] > 0.2
    assert correlation[angle("spine1", 0), angle("spine2", 0)] > 0.5
    assert correlation[angle("left_shoulder", 2), angle("left_collar", 2)] > 0.4


def test_the_same_seed_gives_the_same_poses(prior: PosePrior) -> None:
    poses = prior.sample_poses(3, seed=9)
    assert poses.shape == (3, 24, 3)
    assert (poses[:, 0] == 0).all()
    np.testing.assert_array_equal(poses, prior.sample_poses(3, seed=9))


def test_a_file_can_replace_it_and_wrong_ones_are_named(prior: PosePrior, tmp_path: Path) -> None:
    prior.save(tmp_path / "prior.npz")
    again = PosePrior.load(tmp_path / "prior.npz")
    np.testing.assert_array_equal(again.covariance, prior.covariance)
    np.testing.assert_array_equal(again.low, prior.low)

    np.savez(tmp_path / "a.npz", mean=prior.mean)
    with pytest.raises(ValueError, match=r"a\.npz: no covariance in this pose prior \(found: mean\)"):
        PosePrior.load(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", mean=prior.mean[:63], covariance=np.eye(63))
    with pytest.raises(ValueError, match=r"mean has shape \(63,\), expected \(69,\)"):
        PosePrior.load(tmp_path / "b.npz")
    np.savez(tmp_path / "c.npz", mean=prior.mean, covariance=-np.eye(69))
    with pytest.raises(ValueError, match="not positive definite"):
        PosePrior.load(tmp_path / "c.npz")
    (tmp_path / "d.npz").write_text("no")
    with pytest.raises(ValueError, match="not a readable pose prior"):
        PosePrior.load(tmp_path / "d.npz")


def test_natural_motions_are_within_reach(prior: PosePrior) -> None:
    """No joint of a squat, a lunge, a walk or swinging arms lies more than 3.5 standard deviations out."""
    from render.motions import make_motion

    for name in ("squat", "lunge", "walk", "shoulders-mill", "tilt-twist"):
        for seed in range(3):
            off = make_motion(name, 24, seed).pose[:, 1:] - prior.mean.reshape(-1, 3)
            for j in range(23):
                own = slice(3 * j, 3 * j + 3)
                inverse = np.linalg.inv(prior.covariance[own, own])
                far = np.sqrt(np.einsum("ta,ab,tb->t", off[:, j], inverse, off[:, j])).max()
                assert far < 3.6, f"{name}: {JOINT_NAMES[j + 1]} lies {far:.1f} standard deviations out"


def test_its_hash_tells_priors_apart(prior: PosePrior, tmp_path: Path) -> None:
    prior.save(tmp_path / "prior.npz")
    assert PosePrior.load(tmp_path / "prior.npz").content_hash == prior.content_hash
    wider = PosePrior(prior.mean, 1.1 * prior.covariance, prior.low, prior.high)
    assert wider.content_hash != prior.content_hash
