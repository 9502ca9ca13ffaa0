"""The body model: SMPL-structured arrays (Loper et al., SIGGRAPH Asia 2015), their file, and where to get
one.

`load_body("free:neutral")` gives the licence-free body of this package, `load_body("model.npz")` a file of
SMPL, SMPL-H or SMPL-X (`body_file` reads it). Plain numpy: nothing here starts JAX.
"""

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from .body_archive import BodyModelError
from .body_file import BodyFile, read_body_file
from .joint_trees import fold_pose_directions, fold_regressor, fold_weights
from .parts import body_25_regressor, part_labels
from .skeleton import JOINT, PARENTS

FREE_SEXES = ("neutral", "female", "male")
LOWEST_M, TALLEST_M = 0.3, 3.0  # a newborn lies below half a metre; whatever is taller is not in metres


@dataclass(frozen=True)
class BodyModel:
    """A body in SMPL's structure. Metres, T-pose, y up, +z front, +x the body's left."""

    name: str
    licence: str
    template: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    shape_directions: Float[np.ndarray, "v 3 b"]
    """Vertex displacement of one standard deviation of each shape coefficient."""
    pose_directions: Float[np.ndarray, "v 3 p"]
    """Rest-pose correctives by the entries of R - I, joint by joint without the root, row-major: p = 9 (J -
    1).
    """
    weights: Float[np.ndarray, "v j"]
    joint_regressor: Float[np.ndarray, "j v"]
    parents: Int[np.ndarray, "j"]
    """Parent of each joint, -1 for the root; parents come before their children."""
    parts: Int[np.ndarray, "v"]
    """Part label: the joint whose bone moves the vertex most."""
    landmarks: Float[np.ndarray, "25 v"]
    """OpenPose BODY_25 points as combinations of vertices (order: `parts.BODY_25`)."""
    n_anthropometric: int = field(default=-1)
    """The first so many shape components come from body measures; the others (`marks.shape_names`) are named
    places and smooth bumps. -1: all of them."""
    kind: str = "SMPL"
    """What it was made from: SMPL, SMPL-H or SMPL-X. All have SMPL's 24 joints here."""
    gender: str = "unknown"
    """neutral, female, male or unknown: the betas belong to it."""
    notes: tuple[str, ...] = ()
    """A sentence on every thing that was found out or left out while reading."""

    def __post_init__(self) -> None:
        if self.n_anthropometric < 0:
            object.__setattr__(self, "n_anthropometric", self.shape_directions.shape[2])
        n, j = len(self.template), len(self.parents)
        b = self.shape_directions.shape[-1]
        wanted = {
            "template": (n, 3),
            "faces": (len(self.faces), 3),
            "shape_directions": (n, 3, b),
            "pose_directions": (n, 3, 9 * (j - 1)),
            "weights": (n, j),
            "joint_regressor": (j, n),
            "parts": (n,),
            "landmarks": (25, n),
        }
        for key, shape in wanted.items():
            found = getattr(self, key).shape
            if found != shape:
                raise BodyModelError(
                    f"body {self.name!r}: {key} has shape {found}, expected {shape} "
                    f"for {n} vertices and {j} joints."
                )
        for key in (
            "template",
            "shape_directions",
            "pose_directions",
            "weights",
            "joint_regressor",
            "landmarks",
        ):
            if not np.isfinite(getattr(self, key)).all():
                raise BodyModelError(f"body {self.name!r}: {key} holds values that are not finite.")
        if not len(self.faces) or not n:
            raise BodyModelError(f"body {self.name!r}: there are {n} vertices and {len(self.faces)} faces.")
        if self.faces.min() < 0 or self.faces.max() >= n:
            raise BodyModelError(
                f"body {self.name!r}: faces name vertices from {self.faces.min()} to {self.faces.max()}, "
                f"but there are {n} (0 to {n - 1})."
            )
        if self.parents[0] != -1 or (self.parents[1:] >= np.arange(1, j)).any() or self.parents[1:].min() < 0:
            raise BodyModelError(
                f"body {self.name!r}: the joint tree must start at the root and name parents before "
                f"children; found parents {self.parents.tolist()}."
            )
        _check_weights(f"body {self.name!r}", self.weights)

    @property
    def n_vertices(self) -> int:
        return len(self.template)

    @property
    def n_joints(self) -> int:
        return len(self.parents)

    @property
    def n_betas(self) -> int:
        return self.shape_directions.shape[2]

    @cached_property
    def content_hash(self) -> str:
        """SHA-256 over all arrays that shape the result (not the name): tells a run's body apart from
        another.
        """
        digest = hashlib.sha256()
        for key in ("template", "faces", "shape_directions", "pose_directions", "weights", "joint_regressor"):
            array = np.ascontiguousarray(getattr(self, key))
            digest.update(f"{key} {array.shape} {array.dtype.str}".encode())
            digest.update(array.tobytes())
        digest.update(str(self.parents.tolist()).encode())
        return digest.hexdigest()

    def shaped(self, betas: Float[np.ndarray, "b"]) -> Float[np.ndarray, "v 3"]:
        """The template of these shape coefficients; fewer than `n_betas` leave the rest at zero."""
        return self.template + self.shape_directions[:, :, : len(betas)] @ betas

    def with_betas(self, n_betas: int) -> "BodyModel":
        """The same body with its first n_betas shape components only."""
        kept = min(self.n_anthropometric, n_betas)
        return replace(self, shape_directions=self.shape_directions[:, :, :n_betas], n_anthropometric=kept)

    def save(self, path: str | Path) -> None:
        """Write an .npz under SMPL's key names, atomically (a temporary name in the same folder, then a
        rename).
        """
        from .marks import marks_of  # marks are of a model: they import this module's neighbours

        self.as_file().save(path, hash=np.array(self.content_hash), **marks_of(self))

    def as_file(self) -> BodyFile:
        """The same as a file's content: a body of 24 joints, whatever it was made from."""
        return BodyFile(
            name=self.name,
            licence=self.licence,
            kind="SMPL",
            gender=self.gender,
            template=self.template,
            faces=self.faces,
            shape_directions=self.shape_directions,
            expression_directions=np.zeros((self.n_vertices, 3, 0)),
            pose_directions=self.pose_directions,
            weights=self.weights,
            joint_regressor=self.joint_regressor,
            parents=self.parents,
            parts=self.parts,
            landmarks=self.landmarks,
            n_anthropometric=self.n_anthropometric,
        )

    @staticmethod
    def load(path: str | Path) -> "BodyModel":
        """Read a body of the SMPL family (.npz or .pkl). Raises BodyModelError with the reason."""
        return BodyModel.of_file(read_body_file(path), str(path))

    @staticmethod
    def of_file(file: BodyFile, where: str = "") -> "BodyModel":
        """The body with SMPL's 24 joints: of SMPL-H and SMPL-X with hands and face held at rest (exact, see
        `joint_trees`). Raises BodyModelError, beginning with `where`, for what cannot be a body."""
        where = where or f"body {file.name!r}"
        template = file.template.astype(np.float64)
        weights = file.weights.astype(np.float64)
        regressor = fold_regressor(file.kind, file.joint_regressor.astype(np.float64))
        _check_weights(where, weights)
        _check_upright(where, template, regressor @ template)
        weights = fold_weights(file.kind, weights)
        parts = part_labels(weights) if file.parts is None else file.parts
        try:
            landmarks = (
                body_25_regressor(template, parts, regressor)
                if file.landmarks is None
                else file.landmarks.astype(np.float64)
            )
        except ValueError as error:
            raise BodyModelError(f"{where}: {error}") from error
        return BodyModel(
            name=file.name,
            licence=file.licence,
            template=template,
            faces=file.faces,
            shape_directions=file.shape_directions.astype(np.float64),
            pose_directions=fold_pose_directions(file.kind, file.pose_directions.astype(np.float64)),
            weights=weights,
            joint_regressor=regressor,
            parents=np.array(PARENTS),
            parts=parts,
            landmarks=landmarks,
            n_anthropometric=file.n_anthropometric,
            kind=file.kind,
            gender=file.gender,
            notes=file.notes,
        )


def _check_weights(where: str, weights: Float[np.ndarray, "v j"]) -> None:
    total = weights.sum(1)
    worst = int(np.abs(total - 1).argmax())
    if abs(total[worst] - 1) > 1e-3:
        raise BodyModelError(f"{where}: skinning weights of vertex {worst} sum to {total[worst]:.4f}, not 1.")


def _check_upright(where: str, template: Float[np.ndarray, "v 3"], joints: Float[np.ndarray, "24 3"]) -> None:
    """Metres and axes: the commonest mistakes of files that were made by other programs."""
    tall = float(np.ptp(template[:, 1]))
    if not LOWEST_M < tall < TALLEST_M:
        raise BodyModelError(
            f"{where}: the template is {tall:.3g} high (y), expected {LOWEST_M} to {TALLEST_M} metres. "
            f"Scale it to metres, y up."
        )
    head_up = joints[JOINT["head"], 1] - joints[JOINT["pelvis"], 1]
    hips = joints[JOINT["left_hip"], 0] - joints[JOINT["right_hip"], 0]
    if head_up < 0.1 * tall or hips < 0.02 * tall:
        raise BodyModelError(
            f"{where}: the template does not stand with y up and its left towards +x "
            f"(head {head_up:+.2f} m above the pelvis, left hip {hips:+.2f} m from the right). Turn it so."
        )


def load_body(spec: str | Path, *, show_progress: bool = True) -> BodyModel:
    """The body of this specification: 'free:neutral', 'free:female', 'free:male', or the path of an .npz or
    .pkl of SMPL, SMPL-H or SMPL-X.

    A free body is built at its first use (under a minute, with a progress bar) and then read from the user's
    cache.
    """
    text = str(spec)
    if not text.startswith("free:"):
        return BodyModel.load(text)
    sex_name = text.removeprefix("free:")
    if sex_name not in FREE_SEXES:
        raise BodyModelError(
            f"{text}: there is no such free body. There are free:neutral, free:female and free:male."
        )
    from .build import load_or_build  # only the builder needs scikit-image

    return load_or_build(sex_name, show_progress=show_progress)
