"""The body model: SMPL-structured arrays (Loper et al., SIGGRAPH Asia 2015), their file, and where to get
one.

`load_body("free:neutral")` gives the licence-free body of this package, `load_body("model.npz")` any file
with SMPL's arrays under SMPL's key names. Plain numpy: nothing here starts JAX.
"""

import hashlib
import os
import zipfile
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from .parts import body_25_regressor, part_labels
from .skeleton import N_JOINTS, PARENTS

SMPL_KEYS = ("v_template", "f", "shapedirs", "posedirs", "weights", "J_regressor", "kintree_table")
FREE_SEXES = ("neutral", "female", "male")


class BodyModelError(ValueError):
    """A body that cannot be had: one or two lines for the user saying what was found and what to do."""


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
    """The first so many shape components come from body measures; the rest are smooth bumps along the normal.
    -1: all of them."""

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
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        parents = np.where(self.parents < 0, 2**32 - 1, self.parents).astype(np.uint32)  # as SMPL's files do
        # The process number keeps two writers apart; an ordinary open keeps the user's file permissions.
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with temporary.open("wb") as stream:
                np.savez_compressed(
                    stream,
                    v_template=self.template,
                    f=self.faces.astype(np.uint32),
                    shapedirs=self.shape_directions,
                    posedirs=self.pose_directions,
                    weights=self.weights,
                    J_regressor=self.joint_regressor,
                    kintree_table=np.stack([parents, np.arange(len(parents), dtype=np.uint32)]),
                    J=self.joint_regressor @ self.template,
                    name=np.array(self.name),
                    licence=np.array(self.licence),
                    hash=np.array(self.content_hash),
                    parts=self.parts,
                    landmarks=self.landmarks,
                    n_anthropometric=np.array(self.n_anthropometric),
                )
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    @staticmethod
    def load(path: str | Path) -> "BodyModel":
        """Read an .npz with SMPL's keys (24 joints). Raises BodyModelError with the reason."""
        path = Path(path)
        arrays = _read_arrays(path)
        missing = [key for key in SMPL_KEYS if key not in arrays]
        if missing:
            found = ", ".join(sorted(arrays)) or "nothing"
            raise BodyModelError(
                f"{path}: no {', '.join(missing)} in this body file (found: {found}). "
                f"An SMPL-format .npz holds {', '.join(SMPL_KEYS)}."
            )
        dimensions = {"v_template": 2, "f": 2, "shapedirs": 3, "posedirs": 3, "weights": 2, "J_regressor": 2}
        for key, n_axes in {**dimensions, "kintree_table": 2}.items():
            if arrays[key].ndim != n_axes or not np.issubdtype(arrays[key].dtype, np.number):
                raise BodyModelError(
                    f"{path}: {key} is an array of shape {arrays[key].shape} and type {arrays[key].dtype}, "
                    f"expected numbers with {n_axes} axes."
                )
        parents = arrays["kintree_table"][0].astype(np.int64)
        parents[parents == 2**32 - 1] = -1  # SMPL stores the root's missing parent as the largest uint32
        if len(parents) != N_JOINTS or tuple(parents) != PARENTS:
            raise BodyModelError(
                f"{path}: kintree_table has {len(parents)} joints"
                f"{' in another order' if len(parents) == N_JOINTS else ''}; "
                f"bodies with SMPL's {N_JOINTS} joints are read (not SMPL-H or SMPL-X)."
            )

        def numbers(key: str) -> np.ndarray:
            array = np.ascontiguousarray(arrays[key], dtype=np.float64)
            if not np.isfinite(array).all():
                raise BodyModelError(f"{path}: {key} holds values that are not finite.")
            return array

        template, weights, regressor = numbers("v_template"), numbers("weights"), numbers("J_regressor")
        for key, shape, wanted in (
            ("weights", weights.shape, (len(template), N_JOINTS)),
            ("J_regressor", regressor.shape, (N_JOINTS, len(template))),
        ):
            if shape != wanted:
                raise BodyModelError(
                    f"{path}: {key} has shape {shape}, expected {wanted} for {len(template)} vertices."
                )
        _check_weights(str(path), weights)
        parts = arrays["parts"].astype(np.int64) if "parts" in arrays else part_labels(weights)
        landmarks = (
            numbers("landmarks") if "landmarks" in arrays else body_25_regressor(template, parts, regressor)
        )
        return BodyModel(
            name=str(arrays["name"]) if "name" in arrays else path.stem,
            licence=str(arrays["licence"]) if "licence" in arrays else "unknown (see the file's origin)",
            template=template,
            faces=arrays["f"].astype(np.int64),
            shape_directions=numbers("shapedirs"),
            pose_directions=numbers("posedirs"),
            weights=weights,
            joint_regressor=regressor,
            parents=parents,
            parts=parts,
            landmarks=landmarks,
            n_anthropometric=int(arrays["n_anthropometric"]) if "n_anthropometric" in arrays else -1,
        )


def _check_weights(where: str, weights: Float[np.ndarray, "v j"]) -> None:
    total = weights.sum(1)
    worst = int(np.abs(total - 1).argmax())
    if abs(total[worst] - 1) > 1e-3:
        raise BodyModelError(f"{where}: skinning weights of vertex {worst} sum to {total[worst]:.4f}, not 1.")


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an .npz, none of them a pickle (a pickle is a program)."""
    if not path.exists():
        raise BodyModelError(
            f"{path}: no such body file. Use free:neutral, free:female, free:male, "
            f"or the path of an SMPL-format .npz."
        )
    if path.suffix != ".npz":
        raise BodyModelError(
            f"{path}: body files are read as .npz, this is {path.suffix or 'without a suffix'}. "
            f"Convert it to an .npz with the keys {', '.join(SMPL_KEYS)}."
        )
    try:
        # numpy leaves a file that it opened itself open when the archive is damaged
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {}
            for key in archive.files:
                try:
                    arrays[key] = archive[key]
                except ValueError as error:
                    if key in SMPL_KEYS:
                        raise BodyModelError(
                            f"{path}: {key} is stored as a pickled object, which is not opened. "
                            f"Store it as a plain array (a sparse J_regressor: J_regressor.toarray())."
                        ) from error
            return arrays
    except BodyModelError:
        raise
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise BodyModelError(
            f"{path}: not a readable .npz ({error}). Copy or download the file again."
        ) from error


def load_body(spec: str | Path, *, show_progress: bool = True) -> BodyModel:
    """The body of this specification: 'free:neutral', 'free:female', 'free:male', or the path of an .npz.

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
