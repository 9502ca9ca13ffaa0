"""Body files of every format in use, written from the free body: the licensed ones cannot be here.

Python 2's pickles are imitated byte by byte where it matters: text as its strings, numpy's and scipy's old
module paths, chumpy's objects by stand-ins of the same names.
"""

import io
import pickle
import struct
import sys
import types
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.sparse import csc_matrix

from fit.body import BodyModel, load_body
from fit.body.joint_trees import TREES
from fit.body.skeleton import (
    JOINT,
    PARENTS,
    axis_angle_to_matrix,
    blend_linearly,
    world_from_rest,
)

Arrays = dict[str, np.ndarray]
N_BETAS = 10
FINGER_SPREAD_M = 0.018  # between the made fingers


def smpl_arrays() -> Arrays:
    """The neutral body under SMPL's keys, as a file of the first edition has it (single precision)."""
    body = load_body("free:neutral", show_progress=False)
    return {
        "v_template": body.template.astype(np.float32),
        "f": body.faces.astype(np.uint32),
        "shapedirs": body.shape_directions[:, :, :N_BETAS].astype(np.float32),
        "posedirs": body.pose_directions.astype(np.float32),
        "weights": body.weights.astype(np.float32),
        "J_regressor": body.joint_regressor.astype(np.float32),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)], dtype=np.uint32),
    }


def fingered_arrays(kind: str, n_components: int = N_BETAS) -> Arrays:
    """The neutral body with the joints of SMPL-H or SMPL-X: fifteen finger joints a hand (and jaw and eyes),
    each moving the nearest vertices of hand or head, with small correctives of its own."""
    plain, parents = smpl_arrays(), TREES[kind]
    template = plain["v_template"].astype(np.float64)
    n, j = len(template), len(parents)
    weights = np.zeros((n, j))
    weights[:, :22] = plain["weights"][:, :22]
    regressor = np.zeros((j, n))
    regressor[:22] = plain["J_regressor"][:22]
    joints = plain["J_regressor"].astype(np.float64) @ template
    centre: dict[int, np.ndarray] = {}
    first = 25 if kind == "SMPL-X" else 22
    if kind == "SMPL-X":
        off_head = {22: (0, 0, 0.04), 23: (0.03, 0.06, 0.08), 24: (-0.03, 0.06, 0.08)}
        centre |= {joint: joints[JOINT["head"]] + np.array(offset) for joint, offset in off_head.items()}
    for side, (wrist, hand) in enumerate(((20, 22), (21, 23))):
        along = joints[hand] - joints[wrist]
        for finger, across in enumerate((1.0, 0.0, -2.0, -1.0, 2.0)):  # index, middle, little, ring, thumb
            for k in range(3):
                place = joints[hand] + along * 0.35 * k + np.array([0, 0, across * FINGER_SPREAD_M])
                centre[first + 15 * side + 3 * finger + k] = place
    for joint, place in centre.items():
        distance = np.linalg.norm(template - place, axis=1)
        nearest = np.argsort(distance)[:12]
        regressor[joint, nearest] = 1 / 12
    near = {
        20: [c for c in centre if first <= c < first + 15],
        21: [c for c in centre if c >= first + 15],
        15: [c for c in (22, 23, 24) if kind == "SMPL-X"],
    }
    old = plain["weights"].astype(np.float64)
    for owner, own in near.items():
        moved = old[:, owner] + (old[:, owner + 2] if owner >= 20 else 0)
        if not own:
            continue
        distance = np.linalg.norm(template[:, None] - np.stack([centre[c] for c in own]), axis=2)
        closest = np.array(own)[distance.argmin(1)]
        share = 0.6 * np.exp(-((distance.min(1) / 0.03) ** 2))
        weights[:, owner] = moved * (1 - share)
        np.add.at(weights, (np.arange(n), closest), moved * share)
    random = np.random.default_rng(5)
    poses = np.zeros((n, 3, 9 * (j - 1)))
    poses[:, :, : 9 * 21] = plain["posedirs"][:, :, : 9 * 21]
    poses[:, :, 9 * 21 :] = 1e-4 * random.standard_normal((n, 3, 9 * (j - 22)))
    shapes = 1e-3 * random.standard_normal((n, 3, n_components))
    shapes[:, :, :N_BETAS] = plain["shapedirs"][:, :, : min(N_BETAS, n_components)]
    root = [2**32 - 1, *parents[1:]]
    return {
        **plain,
        "weights": weights,
        "J_regressor": regressor,
        "posedirs": poses,
        "shapedirs": shapes,
        "kintree_table": np.array([root, range(j)], dtype=np.int64),
    }


class Python2Pickler(pickle._Pickler):  # type: ignore[name-defined]
    """Writes text and bytes as Python 2's one kind of string."""

    def save_string(self, value: bytes | str) -> None:
        data = value if isinstance(value, bytes) else value.encode("latin-1")
        if not self.bin:
            self.write(b"S" + repr(data)[1:].encode() + b"\n")
        elif len(data) < 256:
            self.write(b"U" + struct.pack("<B", len(data)) + data)
        else:
            self.write(b"T" + struct.pack("<i", len(data)) + data)
        self.memoize(value)

    dispatch: ClassVar = {**pickle._Pickler.dispatch, bytes: save_string, str: save_string}  # type: ignore[attr-defined]


def python2_pickle(value: object, protocol: int = 2) -> bytes:
    """As Python 2 with an old numpy and scipy would have written it."""
    stream = io.BytesIO()
    Python2Pickler(stream, protocol).dump(value)
    data = stream.getvalue()
    return data.replace(b"cnumpy._core.", b"cnumpy.core.").replace(b"cscipy.sparse._", b"cscipy.sparse.")


@contextmanager
def chumpy_stand_in() -> Iterator[tuple[type, type]]:
    """Modules named as chumpy's while pickling: (Ch, Select). chumpy itself cannot be installed any more."""
    modules = {name: types.ModuleType(name) for name in ("chumpy", "chumpy.ch", "chumpy.reordering")}
    ch = type("Ch", (), {"__module__": "chumpy.ch"})
    select = type("Select", (ch,), {"__module__": "chumpy.reordering"})
    modules["chumpy.ch"].Ch, modules["chumpy.reordering"].Select = ch, select  # type: ignore[attr-defined]
    sys.modules.update(modules)
    try:
        yield ch, select
    finally:
        for name in modules:
            del sys.modules[name]


def write_chumpy_pickle(path: Path, arrays: Arrays, protocol: int = 2) -> None:
    """The layout of the released SMPL pickles: chumpy objects, a rearranged view, sparse regressors, and keys
    that no one needs."""
    with chumpy_stand_in() as (ch, select):

        def values(array: np.ndarray) -> object:
            made = ch()
            made.__dict__.update(x=array.astype(np.float64), _dirty_vars={"x"}, _itr=None, label=None)
            return made

        view = select()
        order = np.random.default_rng(0).permutation(arrays["shapedirs"].size)
        shuffled = np.empty(order.size)
        shuffled[order] = arrays["shapedirs"].ravel()
        view.__dict__.update(a=values(shuffled), idxs=order, preferred_shape=arrays["shapedirs"].shape)
        content = {
            **arrays,
            "shapedirs": view,
            "posedirs": values(arrays["posedirs"]),
            "v_template": values(arrays["v_template"]),
            "J_regressor": csc_matrix(arrays["J_regressor"]),
            "J_regressor_prior": csc_matrix(arrays["J_regressor"]),
            "J": values(arrays["J_regressor"] @ arrays["v_template"]),
            "bs_style": "lbs",
            "bs_type": "lrotmin",
            "vert_sym_idxs": np.arange(len(arrays["v_template"])),
            "weights_prior": arrays["weights"][:3],
            "pose_training_info": {"gender": b"f", "subjects": [("a", 1.0), ("b", 2.0)]},
        }
        path.write_bytes(python2_pickle(content, protocol))


def posed(arrays: Arrays, betas: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Vertices by the definition, in plain numpy, whatever the number of joints."""
    directions = arrays["shapedirs"][:, :, : len(betas)].astype(np.float64)
    shaped = arrays["v_template"].astype(np.float64) + directions @ betas
    joints = arrays["J_regressor"].astype(np.float64) @ shaped
    parents = tuple(int(p) for p in arrays["kintree_table"][0].astype(np.int64))
    rotations = axis_angle_to_matrix(pose)
    features = (rotations[1:] - np.eye(3)).reshape(-1)
    rest = shaped + arrays["posedirs"].astype(np.float64) @ features
    bones = world_from_rest(rotations, joints, (-1, *parents[1:]))
    return blend_linearly(rest, arrays["weights"].astype(np.float64), bones)[0]


def posed_model(model: BodyModel, betas: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """The same of a model of ours."""
    return posed(
        {
            "v_template": model.template,
            "shapedirs": model.shape_directions,
            "posedirs": model.pose_directions,
            "weights": model.weights,
            "J_regressor": model.joint_regressor,
            "kintree_table": model.parents[None],
        },
        betas,
        pose,
    )
