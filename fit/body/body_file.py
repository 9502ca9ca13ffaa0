"""A body file as it is: SMPL, SMPL-H or SMPL-X arrays with the file's own joints, from .npz or .pkl.

References: Loper et al. 2015 (SMPL), Romero et al. 2017 (SMPL-H), Pavlakos et al. 2019 (SMPL-X). The keys are
those of the released files; other spellings in use are accepted. `model.BodyModel` is made from this.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from .body_archive import BodyArchive, BodyModelError, open_archive
from .joint_trees import KIND_OF_SIZE, TREES
from .marks import KEYS as MARKS

SPELLINGS: dict[str, tuple[str, ...]] = {
    "v_template": ("v_template", "vertices_template", "template", "mesh_template"),
    "f": ("f", "faces", "faces_tensor", "triangles"),
    "shapedirs": ("shapedirs", "shape_dirs", "shape_directions", "mesh_shape_basis"),
    "posedirs": ("posedirs", "pose_dirs", "pose_directions", "mesh_pose_basis"),
    "weights": ("weights", "lbs_weights", "skinning_weights", "skin_weights"),
    "J_regressor": ("J_regressor", "j_regressor", "joint_regressor"),
    "kintree_table": ("kintree_table", "parents", "kinematic_tree", "kintree"),
}
"""SMPL's key -> spellings that are read, best first."""
GENDERS = ("neutral", "female", "male")
N_SHAPE_OF_WIDTH = {400: 300, 20: 10}  # SMPL-X keeps shape and expression in one array, in these two editions
EXTRAS = ("hands_meanl", "hands_meanr", "hands_componentsl", "hands_componentsr", "lmk_faces_idx",
          "lmk_bary_coords", "vt", "ft", *MARKS)  # fmt: skip
"""Plain arrays that are kept for other programs, where a file has them."""
NO_LICENCE = "unknown (see the file's origin)"
_ROOT_MARKS = (-1, 0, 2**32 - 1, 2**64 - 1)


@dataclass(frozen=True)
class BodyFile:
    """What a body file holds. Metres, T-pose, y up, +z front, +x the body's left; J = 24, 52 or 55 joints."""

    name: str
    licence: str
    kind: str
    """SMPL, SMPL-H or SMPL-X: told by the number of joints."""
    gender: str
    """neutral, female, male or unknown: betas belong to it."""
    template: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    shape_directions: Float[np.ndarray, "v 3 b"]
    expression_directions: Float[np.ndarray, "v 3 e"]
    """Of the face, SMPL-X only (otherwise e = 0); never driven here."""
    pose_directions: Float[np.ndarray, "v 3 p"]
    """p = 9 (J - 1)."""
    weights: Float[np.ndarray, "v j"]
    joint_regressor: Float[np.ndarray, "j v"]
    parents: Int[np.ndarray, "j"]
    parts: Int[np.ndarray, "v"] | None = None
    landmarks: Float[np.ndarray, "25 v"] | None = None
    n_anthropometric: int = -1
    notes: tuple[str, ...] = ()
    """A sentence on every thing that was found out or left out while reading."""
    extras: Mapping[str, np.ndarray] = field(default_factory=dict)

    def save(self, path: str | Path, **more: np.ndarray) -> None:
        """Write an .npz under SMPL's keys without pickles inside, atomically (a temporary name in the same
        folder, then a rename). Reading it gives the same arrays, bit by bit."""
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        parents = np.where(self.parents < 0, 2**32 - 1, self.parents).astype(np.uint32)  # as SMPL's files do
        shapes = np.concatenate([self.shape_directions, self.expression_directions], 2)
        arrays: dict[str, Any] = {
            "v_template": self.template,
            "f": self.faces.astype(np.uint32),
            "shapedirs": shapes,
            "posedirs": self.pose_directions,
            "weights": self.weights,
            "J_regressor": self.joint_regressor,
            "kintree_table": np.stack([parents, np.arange(len(parents), dtype=np.uint32)]),
            "J": self.joint_regressor @ self.template,
            "n_shape": np.array(self.shape_directions.shape[2]),
            "name": np.array(self.name),
            "licence": np.array(self.licence),
            "gender": np.array(self.gender),
            **self.extras,
            **more,
        }
        if self.parts is not None:
            arrays["parts"] = self.parts
        if self.landmarks is not None:
            arrays["landmarks"] = self.landmarks
        if self.n_anthropometric >= 0:
            arrays["n_anthropometric"] = np.array(self.n_anthropometric)
        # The process number keeps two writers apart; an ordinary open keeps the user's file permissions.
        temporary = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            with temporary.open("wb") as stream:
                np.savez_compressed(stream, **arrays)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def read_body_file(path: str | Path) -> BodyFile:
    """Read an .npz or .pkl of the SMPL family. Raises BodyModelError: which key is missing, which shape is
    wrong, or what in a pickle is refused."""
    path = Path(path)
    archive = open_archive(path)
    found = {key: next((s for s in names if s in archive.names), "") for key, names in SPELLINGS.items()}
    missing = [key for key, name in found.items() if not name]
    if missing:
        raise BodyModelError(
            f"{path}: no {', '.join(missing)} in this body file (found: {archive.listed}). "
            f"A body of the SMPL family holds {', '.join(SPELLINGS)}."
        )
    template = _numbers(archive, found["v_template"], 2)
    n = len(template)
    parents = _parents(archive, found["kintree_table"])
    kind, j = KIND_OF_SIZE[len(parents)], len(parents)
    faces = archive.array(found["f"])
    if faces.ndim != 2 or faces.dtype.kind not in "iuf" or (faces != np.round(faces)).any():
        raise BodyModelError(
            f"{path}: {found['f']} is an array of shape {faces.shape} and type {faces.dtype}, "
            f"expected whole numbers, (n, 3)."
        )
    weights = _turned(_numbers(archive, found["weights"], 2), (n, j))
    regressor = _turned(_numbers(archive, found["J_regressor"], 2), (j, n))
    poses = _by_vertex(_numbers(archive, found["posedirs"], 2, 3), n, 9 * (j - 1))
    shapes = _by_vertex(_numbers(archive, found["shapedirs"], 2, 3), n, None)
    wanted = {
        "v_template": (template.shape, (n, 3)),
        "f": (faces.shape, (len(faces), 3)),
        "shapedirs": (shapes.shape, (n, 3, shapes.shape[-1])),
        "posedirs": (poses.shape, (n, 3, 9 * (j - 1))),
        "weights": (weights.shape, (n, j)),
        "J_regressor": (regressor.shape, (j, n)),
    }
    parts = _numbers(archive, "parts", 1).astype(np.int64) if "parts" in archive.names else None
    landmarks = _numbers(archive, "landmarks", 2) if "landmarks" in archive.names else None
    if parts is not None:
        wanted["parts"] = (parts.shape, (n,))
    if landmarks is not None:
        wanted["landmarks"] = (landmarks.shape, (25, n))
    for key, (shape, expected) in wanted.items():
        if shape != expected:
            raise BodyModelError(
                f"{path}: {found.get(key, key)} has shape {shape}, expected {expected} "
                f"for {n} vertices and {j} joints ({kind})."
            )
    notes = [f"{found[key]} is read as {key}" for key in SPELLINGS if found[key] != key]
    shapes, expressions = _shape_and_expression(archive, kind, shapes, notes)
    return BodyFile(
        name=_one_line(archive.text("name")) if "name" in archive.names else _name_of(path),
        licence=_one_line(archive.text("licence")) if "licence" in archive.names else NO_LICENCE,
        kind=kind,
        gender=_gender(archive),
        template=template,
        faces=faces.astype(np.int64),
        shape_directions=shapes,
        expression_directions=expressions,
        pose_directions=poses,
        weights=weights,
        joint_regressor=regressor,
        parents=parents,
        parts=parts,
        landmarks=landmarks,
        n_anthropometric=_whole_number(archive, "n_anthropometric", -1),
        notes=tuple(notes),
        extras=_extras(archive),
    )


def _numbers(archive: BodyArchive, name: str, *n_axes: int) -> np.ndarray:
    """A finite array in floating point, single or double precision as in the file."""
    array = archive.array(name)
    if array.ndim not in n_axes or array.dtype.kind not in "iuf":
        raise BodyModelError(
            f"{archive.path}: {name} is an array of shape {array.shape} and type {array.dtype}, "
            f"expected numbers with {' or '.join(map(str, reversed(n_axes)))} axes."
        )
    if array.dtype not in (np.dtype("=f4"), np.dtype("=f8")):
        array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise BodyModelError(f"{archive.path}: {name} holds values that are not finite.")
    return np.ascontiguousarray(array)


def _whole_number(archive: BodyArchive, name: str, otherwise: int) -> int:
    if name not in archive.names:
        return otherwise
    array = archive.array(name)
    if array.size != 1 or array.dtype.kind not in "iu":
        raise BodyModelError(f"{archive.path}: {name} is no whole number.")
    return int(array.reshape(-1)[0])


def _turned(array: np.ndarray, wanted: tuple[int, int]) -> np.ndarray:
    """The transpose, where that is what has the wanted shape."""
    return np.ascontiguousarray(array.T) if array.shape == wanted[::-1] != wanted else array


def _by_vertex(array: np.ndarray, n_vertices: int, width: int | None) -> np.ndarray:
    """(V 3 K) from flattened layouts: (3 V, K), or (K, 3 V) as some loaders keep it."""
    if array.ndim == 2 and array.shape[0] == 3 * n_vertices and width in (None, array.shape[1]):
        return array.reshape(n_vertices, 3, -1)
    if array.ndim == 2 and array.shape[1] == 3 * n_vertices and width in (None, array.shape[0]):
        return np.ascontiguousarray(array.T).reshape(n_vertices, 3, -1)
    return array


def _parents(archive: BodyArchive, name: str) -> Int[np.ndarray, "j"]:
    """The joint tree, compared with those that are known. A root's parent is written as -1, 0 or 2^32 - 1."""
    table = archive.array(name)
    if table.dtype.kind not in "iuf" or table.ndim not in (1, 2) or not np.isfinite(table).all():
        raise BodyModelError(
            f"{archive.path}: {name} is an array of shape {table.shape} and type {table.dtype}, "
            f"expected numbers: parents (J) or SMPL's table (2, J)."
        )
    if table.ndim == 2 and table.shape[1] == 2 != table.shape[0]:
        table = table.T
    row = table if table.ndim == 1 else table[0]
    if len(row) not in KIND_OF_SIZE:
        raise BodyModelError(
            f"{archive.path}: {name} has {len(row)} joints; bodies of SMPL (24), SMPL-H (52) and SMPL-X (55) "
            f"are read."
        )
    kind = KIND_OF_SIZE[len(row)]
    parents = np.array([-1 if k == 0 and int(p) in _ROOT_MARKS else int(p) for k, p in enumerate(row)])
    odd = np.flatnonzero(parents != TREES[kind])
    if len(odd):
        raise BodyModelError(
            f"{archive.path}: {name} has {len(row)} joints in another order than {kind}'s: "
            f"joint {odd[0]} hangs on {parents[odd[0]]}, not on {TREES[kind][odd[0]]}."
        )
    return parents


def _shape_and_expression(
    archive: BodyArchive, kind: str, directions: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    width = int(directions.shape[2])
    usual: int = N_SHAPE_OF_WIDTH.get(width, width) if kind == "SMPL-X" else width
    n_shape = min(max(_whole_number(archive, "n_shape", usual), 0), width)
    if kind == "SMPL-X":
        notes.append(
            f"of {width} shape and expression components the first {n_shape} are shape; "
            f"the face keeps its rest expression"
            if n_shape < width
            else f"all {width} components are taken for shape, none for expression"
        )
    return np.ascontiguousarray(directions[:, :, :n_shape]), np.ascontiguousarray(directions[:, :, n_shape:])


def _one_line(text: str) -> str:
    """Text of unknown origin as a terminal can show it."""
    return "".join(c if c.isprintable() else " " for c in text[:200]).strip()


def _name_of(path: Path) -> str:
    """The file's name; with its folder's where it says nothing by itself (female/model.npz)."""
    return f"{path.parent.name}/{path.stem}" if path.stem.lower() == "model" else path.stem


def _gender(archive: BodyArchive) -> str:
    """From the key `gender`, otherwise from the names of the file and its folder."""
    for key in ("gender", "name"):
        try:
            told = gender_in(archive.text(key)) if key in archive.names else "unknown"
        except BodyModelError:
            continue  # a number or the like, whose meaning is anybody's guess
        if told != "unknown":
            return told
    return gender_of_path(archive.path)


def gender_in(text: str) -> str:
    """neutral, female or male where the text says so (in full, or as a letter by itself), else unknown."""
    words = re.split(r"[^a-z]+", text.lower())
    for gender in ("female", "male", "neutral"):  # female first: it contains male
        if any(gender in word for word in words):
            return gender
    letters = [word for word in words if word in ("f", "m", "n")]
    return {"f": "female", "m": "male", "n": "neutral"}[letters[0]] if letters else "unknown"


def gender_of_path(path: Path) -> str:
    """As the usual file names say it: SMPL_FEMALE, basicmodel_m_lbs, SMPLX_NEUTRAL, female/model."""
    told = gender_in(path.stem)
    if told == "unknown" and path.absolute().parent.name.lower() in (*GENDERS, "f", "m", "n"):
        told = gender_in(path.absolute().parent.name)
    return told


def _extras(archive: BodyArchive) -> dict[str, np.ndarray]:
    kept = {}
    for name in EXTRAS:
        if name in archive.names:
            try:
                array = archive.array(name)
            except BodyModelError:
                continue  # nothing of ours depends on it
            if array.dtype.kind in "iufbU":
                kept[name] = array
    return kept
