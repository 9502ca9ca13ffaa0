"""What poses people take: a Gaussian over the 23 joint rotations, built from published ranges of motion.

Ranges are round figures of the usual clinical tables (those of the American Academy of Orthopaedic Surgeons
and Boone & Azen 1979 are the common sources; hips, knees, ankles, elbows and wrists were compared with
secondary tables, the originals were not consulted). How trunk and neck share theirs among the model's joints
is ours, and so are means, standard deviations and couplings: a relaxed stance with hanging arms, narrow
enough that a drawn pose is an everyday one. Deep hip and knee bends (squats, chairs) and arms overhead
therefore lie about three standard deviations out. Knees and elbows bend one way only: their means are bent,
and samples are cut at the range.

Rotation vectors per joint in the T-pose's axes (x the body's left, y up, z front), radians. They are treated
as three plain numbers: right for single-axis bends, good enough for a prior elsewhere.
"""

import hashlib
import os
import zipfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .skeleton import JOINT, JOINT_NAMES, LEFT_JOINTS, MIRROR, N_JOINTS

N_ANGLES = 3 * (N_JOINTS - 1)

# Left side and midline, degrees: (low, high) of the range, mean, standard deviation.
# On the right y and z change sign. A left arm: -z lowers it, -y swings it forward, x twists it.
_Row = tuple[float, float, float, float]
RANGES_DEG: dict[str, tuple[_Row, _Row, _Row]] = {
    # hip: x - flexion 120 / extension 20; y external 45 / internal 40 rotation; z abduction 45 / adduction 25
    "left_hip": ((-120, 20, -14, 24), (-40, 45, 4, 11), (-25, 45, 4, 9)),
    # knee: x flexion 0 to 140; the other axes give a little
    "left_knee": ((0, 140, 25, 24), (-10, 10, 0, 3), (-6, 6, 0, 2)),
    # ankle: x plantar flexion 45 / - dorsiflexion 20, but near 40 under the body's weight (squats, lunges);
    # y, z: rotation, inversion and eversion
    "left_ankle": ((-38, 45, -2, 12), (-15, 15, 0, 5), (-15, 25, 0, 6)),
    # toes: x - extension 60 / flexion 20
    "left_foot": ((-60, 20, -4, 10), (-5, 5, 0, 2), (-5, 5, 0, 2)),
    # trunk: flexion 80, extension 25, side bend 35, rotation 45 in all
    "spine1": ((-8, 30, 3, 6.5), (-14, 14, 0, 5.5), (-12, 12, 0, 4)),
    "spine2": ((-8, 26, 2, 5.5), (-16, 16, 0, 6), (-12, 12, 0, 3.5)),
    "spine3": ((-9, 24, 2, 4.5), (-15, 15, 0, 5.5), (-11, 11, 0, 3)),
    # neck and head: flexion 50, extension 60, side bend 45, rotation 80 in all
    "neck": ((-30, 25, 2, 8), (-35, 35, 0, 9), (-22, 22, 0, 5)),
    "head": ((-30, 25, 0, 8), (-45, 45, 0, 10), (-22, 22, 0, 5)),
    # shoulder girdle: z elevation 30 / depression 10; y - protraction 15 / retraction 15
    "left_collar": ((-6, 6, 0, 2), (-15, 15, 0, 5), (-10, 30, -3, 6)),
    # shoulder about the girdle: z - down 90 / up 65 from the T-pose; y - forward 135 / back 40; x twist
    "left_shoulder": ((-70, 70, 4, 18), (-125, 40, -14, 24), (-90, 65, -58, 29)),
    # elbow: y - flexion 0 to 145; x shares pronation and supination (80 each) with the wrist
    "left_elbow": ((-30, 30, 0, 9), (-145, 0, -34, 26), (-6, 6, 0, 2)),
    # wrist: x twist; y radial 20 / ulnar 30 deviation; z - flexion 70 / extension 70
    "left_wrist": ((-60, 60, 0, 16), (-30, 20, 0, 7), (-70, 70, -2, 12)),
    # fingers as one: z - curled
    "left_hand": ((-10, 10, 0, 3), (-10, 10, 0, 3), (-60, 20, -8, 9)),
}

_X, _Y, _Z = 0, 1, 2
# Correlations between left-side (or midline) angles; each is mirrored.
_COUPLINGS: tuple[tuple[str, int, str, int, float], ...] = (
    ("left_hip", _X, "left_knee", _X, -0.60),  # walking, squatting, sitting
    ("left_hip", _X, "right_hip", _X, 0.35),  # both hips in squats and chairs
    ("left_knee", _X, "right_knee", _X, 0.40),
    ("left_hip", _X, "right_knee", _X, -0.25),
    ("left_knee", _X, "left_ankle", _X, -0.40),  # shin forward over the foot
    ("left_hip", _X, "left_hip", _Z, -0.20),  # a raised thigh moves out
    ("left_hip", _Y, "left_hip", _Z, 0.30),
    ("left_hip", _Z, "left_ankle", _Z, -0.35),  # the sole stays flat
    ("left_hip", _X, "spine1", _X, -0.25),  # leaning into a squat
    *((a, axis, b, axis, r) for axis in (_X, _Y, _Z) for a, b, r in (
        ("spine1", "spine2", 0.75), ("spine2", "spine3", 0.75), ("spine1", "spine3", 0.60),
        ("neck", "head", 0.50),
    )),
    ("spine3", _Y, "neck", _Y, 0.20),
    ("spine3", _X, "neck", _X, -0.25),  # the face stays level
    ("left_collar", _Z, "left_shoulder", _Z, 0.65),  # scapulohumeral rhythm, about 1 to 2
    ("left_collar", _Y, "left_shoulder", _Y, 0.50),
    ("left_shoulder", _Y, "left_elbow", _Y, 0.35),  # hands brought forward bend elbows
    ("left_shoulder", _Z, "right_shoulder", _Z, -0.30),  # both arms up (z mirrors)
    ("left_shoulder", _Y, "right_shoulder", _Y, -0.15),
    ("left_elbow", _Y, "right_elbow", _Y, -0.30),
    ("left_elbow", _X, "left_wrist", _X, 0.40),
)  # fmt: skip


@dataclass(frozen=True)
class PosePrior:
    """Gaussian over all joints but the root, joint by joint in the model's order: index 3 (joint - 1) + axis.

    mean, low, high (69,) rad; covariance (69, 69) rad2. `low` and `high` bound what `sample` returns.
    """

    mean: Float[np.ndarray, "a"]
    covariance: Float[np.ndarray, "a a"]
    low: Float[np.ndarray, "a"]
    high: Float[np.ndarray, "a"]

    @staticmethod
    def standard() -> "PosePrior":
        """The prior of this module's tables."""
        rows = np.zeros((N_JOINTS, 3, 4))
        for name, axes in RANGES_DEG.items():
            rows[JOINT[name]] = axes
        flip = np.array([1.0, -1.0, -1.0])
        for j in LEFT_JOINTS:
            low, high, mean, sd = np.moveaxis(rows[j], -1, 0)
            mirrored = np.sort(np.stack([low * flip, high * flip]), axis=0)
            rows[MIRROR[j]] = np.stack([*mirrored, mean * flip, sd], -1)
        low, high, mean, sd = np.moveaxis(np.radians(rows[1:]).reshape(-1, 4), -1, 0)
        correlation = _nearest_correlation(_coupling_matrix())
        return PosePrior(mean.copy(), correlation * np.outer(sd, sd), low.copy(), high.copy())

    @cached_property
    def precision(self) -> Float[np.ndarray, "a a"]:
        """Inverse of the covariance."""
        inverse = np.linalg.inv(self.covariance)
        return 0.5 * (inverse + inverse.T)

    @cached_property
    def whitening(self) -> Float[np.ndarray, "a a"]:
        """W such that |W (angles - mean)|2 is the squared Mahalanobis distance: a least-squares residual."""
        return np.linalg.inv(np.linalg.cholesky(self.covariance))

    @cached_property
    def content_hash(self) -> str:
        """Short hash of mean and covariance: tells a run's prior apart from another."""
        digest = hashlib.sha256()
        for array in (self.mean, self.covariance):
            digest.update(np.round(array, 9).astype("<f8").tobytes())
        return digest.hexdigest()[:16]

    def sample(self, n: int, seed: int) -> Float[np.ndarray, "n a"]:
        """n poses; an angle beyond its range is set to the end of the range."""
        scores = np.random.default_rng(seed).standard_normal((n, len(self.mean)))
        return np.clip(self.mean + scores @ np.linalg.cholesky(self.covariance).T, self.low, self.high)

    def sample_poses(self, n: int, seed: int) -> Float[np.ndarray, "n 24 3"]:
        """The same with an upright root in front, joint by joint: what skinning takes."""
        angles = self.sample(n, seed).reshape(n, -1, 3)
        return np.concatenate([np.zeros((n, 1, 3)), angles], 1)

    def save(self, path: str | Path) -> None:
        """Write an .npz with the keys mean, covariance, low, high (atomically)."""
        path = Path(path)
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        with temporary.open("wb") as stream:
            np.savez(stream, mean=self.mean, covariance=self.covariance, low=self.low, high=self.high)
        temporary.replace(path)

    @staticmethod
    def load(path: str | Path) -> "PosePrior":
        """Read an .npz with mean (69,) and covariance (69, 69); low and high may be missing."""
        path = Path(path)
        try:
            with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
                arrays = {key: np.asarray(stored[key], dtype=np.float64) for key in stored.files}
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(
                f"{path}: not a readable pose prior ({error}). Give an .npz with mean and covariance."
            ) from error
        for key, shape in (("mean", (N_ANGLES,)), ("covariance", (N_ANGLES, N_ANGLES))):
            if key not in arrays:
                found = ", ".join(sorted(arrays)) or "nothing"
                raise ValueError(f"{path}: no {key} in this pose prior (found: {found}).")
            if arrays[key].shape != shape:
                raise ValueError(
                    f"{path}: {key} has shape {arrays[key].shape}, expected {shape} "
                    f"(all joints but the root)."
                )
        if np.linalg.eigvalsh(arrays["covariance"]).min() <= 0:
            raise ValueError(
                f"{path}: the covariance is not positive definite, so poses have no likelihood under it."
            )
        low = arrays.get("low", np.full(N_ANGLES, -np.pi))
        high = arrays.get("high", np.full(N_ANGLES, np.pi))
        return PosePrior(arrays["mean"], arrays["covariance"], low, high)


def mirror_angles(angles: Float[np.ndarray, "*n a"]) -> Float[np.ndarray, "*n a"]:
    """The pose seen in the mirror plane x = 0: joints swap sides, y and z change sign."""
    per_joint = angles.reshape(*angles.shape[:-1], N_JOINTS - 1, 3)
    return (per_joint[..., MIRROR[1:] - 1, :] * np.array([1.0, -1.0, -1.0])).reshape(angles.shape)


def _coupling_matrix() -> Float[np.ndarray, "a a"]:
    index = {(name, axis): 3 * (j - 1) + axis for j, name in enumerate(JOINT_NAMES) for axis in range(3)}
    correlation = np.eye(N_ANGLES)
    for a, axis_a, b, axis_b, r in _COUPLINGS:
        # y and z mirror with a sign: a coupling of two of them keeps it, of one with an x axis changes it.
        sign = (1 if axis_a == _X else -1) * (1 if axis_b == _X else -1)
        mirrored = (JOINT_NAMES[MIRROR[JOINT[a]]], JOINT_NAMES[MIRROR[JOINT[b]]])
        for (one, other), value in (((a, b), r), (mirrored, sign * r)):
            i, k = index[one, axis_a], index[other, axis_b]
            correlation[i, k] = correlation[k, i] = value
    return correlation


def _nearest_correlation(matrix: Float[np.ndarray, "a a"]) -> Float[np.ndarray, "a a"]:
    """A positive definite correlation matrix near one of hand-set couplings (small eigenvalues lifted)."""
    values, vectors = np.linalg.eigh(matrix)
    lifted = (vectors * np.maximum(values, 0.05)) @ vectors.T
    lifted = 0.5 * (lifted + lifted.T)
    scale = 1 / np.sqrt(np.diag(lifted))
    return lifted * np.outer(scale, scale)
