"""A made rig with the names, controls and files of the Momentum Human Rig, whose assets cannot be here.

A person of tubes in an A-pose, 1.7 m tall, in centimetres inside as MHR's files are. It deforms as MHR does
(Ferguson et al. 2025: shapes, skeleton from controls, skinning) without correctives, and writes MHR's files.
"""

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

N_CONTROLS, N_SHAPES, N_EXPRESSIONS = 204, 45, 72
BODY_COLUMNS = np.r_[0:27, 30:68, 122:136, 139:154]
HEAD_COLUMNS = np.r_[27:30, 136:139]
HAND_COLUMNS = np.r_[68:122, 154:204]
A_POSE = np.radians(40)  # of the arms below the level
BEND, CARRY = np.radians(20), np.radians(4)  # the elbow's at rest: its hinge undoes the first, not the second
CORNERS, RINGS = 8, 5
DOWN = np.array([np.cos(A_POSE), -np.sin(A_POSE), 0])

Tree = dict[str, tuple[str | None, np.ndarray]]


def _tree() -> Tree:
    """Bone -> parent, place at rest (cm, y up, +z front, +x the body's left), in MHR's order."""
    tree: Tree = {"body_world": (None, np.zeros(3)), "root": ("body_world", np.array([0.0, 94, 0]))}

    def add(name: str, parent: str, *place: float) -> None:
        tree[name] = (parent, np.array(place, dtype=float))

    def chain(parent: str, names: list[str], start: np.ndarray, way: np.ndarray) -> None:
        for k, name in enumerate(names):
            add(name, parent, *(start + k * way))
            parent = name

    def twists(name: str, child: str, numbers: range) -> None:
        start, end = tree[name][1], tree[child][1]
        for k in numbers:
            add(f"{name}_twist{k}_proc", name, *(start + k / 5 * (end - start)))

    def leg(s: str, out: float) -> None:
        chain(
            "root",
            [f"{s}_upleg", f"{s}_lowleg", f"{s}_foot"],
            np.array([9.0 * out, 90, 0]),
            np.array([0.5 * out, -41, -1]),
        )
        ankle = tree[f"{s}_foot"][1]
        names = [f"{s}_talocrural", f"{s}_subtalar", f"{s}_transversetarsal", f"{s}_ball"]
        chain(f"{s}_foot", names, ankle + np.array([0, -1, 2]), np.array([0.6 * out, -1.5, 3.5]))
        twists(f"{s}_lowleg", f"{s}_foot", range(1, 5))
        twists(f"{s}_upleg", f"{s}_lowleg", range(5))

    def arm(s: str, out: float) -> None:
        way = DOWN * [out, 1, 1]
        across = np.array([0, 0, 1.0])  # from the little finger to the index
        add(f"{s}_clavicle", "c_spine3", 3 * out, 137, 2)
        shoulder = np.array([17.0 * out, 139, -1])
        elbow = shoulder + 27 * way
        wrist = elbow + 25 * (Rotation.from_rotvec([0, -BEND * out, CARRY * out]).apply(way))
        add(f"{s}_uparm", f"{s}_clavicle", *shoulder)
        add(f"{s}_lowarm", f"{s}_uparm", *elbow)
        add(f"{s}_wrist_twist", f"{s}_lowarm", *wrist)
        add(f"{s}_wrist", f"{s}_wrist_twist", *wrist)
        add(f"{s}_pinky0", f"{s}_wrist", *(wrist + 2 * way - 2 * across))
        for k, finger in enumerate(["pinky", "ring", "middle", "index"]):
            root = f"{s}_pinky0" if finger == "pinky" else f"{s}_wrist"
            names = [f"{s}_{finger}{n}" for n in (1, 2, 3)] + [f"{s}_{finger}_null"]
            chain(root, names, wrist + 8 * way + (2 * k - 3) * across, 2.5 * way)
        thumb = [f"{s}_thumb{n}" for n in range(4)] + [f"{s}_thumb_null"]
        chain(f"{s}_wrist", thumb, wrist + 2 * way + 2 * across, 1.6 * way + 1.6 * across)
        twists(f"{s}_lowarm", f"{s}_wrist", range(1, 5))
        twists(f"{s}_uparm", f"{s}_lowarm", range(5))

    leg("l", 1.0)
    leg("r", -1.0)
    chain("root", [f"c_spine{k}" for k in range(4)], np.array([0.0, 97, 0]), np.array([0.0, 11, 0]))
    arm("r", -1.0)
    arm("l", 1.0)
    add("c_neck", "c_spine3", 0, 145, -1)
    add("c_neck_twist1_proc", "c_neck", 0, 149, 0)
    add("c_neck_twist0_proc", "c_neck", 0, 147, 0)
    add("c_head", "c_neck", 0, 153, 0)
    add("c_jaw", "c_head", 0, 153, 4)
    add("c_teeth", "c_jaw", 0, 152, 8)
    add("c_jaw_null", "c_jaw", 0, 150, 9)
    chain("c_jaw", [f"c_tongue{k}" for k in range(5)], np.array([0.0, 152, 5]), np.array([0.0, 0, 0.8]))
    for s, out in (("r", -1.0), ("l", 1.0)):
        add(f"{s}_eye", "c_head", 3 * out, 158, 8)
        add(f"{s}_eye_null", f"{s}_eye", 3 * out, 158, 10)
    add("c_head_null", "c_head", 0, 171, 0)
    return tree


TREE = _tree()
NAMES = list(TREE)
BONE = {name: k for k, name in enumerate(NAMES)}
PARENTS = [-1 if parent is None else BONE[parent] for parent, _ in TREE.values()]
PLACES = np.stack([place for _, place in TREE.values()])

_LIMBS = [("upleg", "lowleg", 8.0), ("lowleg", "foot", 5.0), ("foot", "ball", 3.5),
          ("clavicle", "uparm", 5.0), ("uparm", "lowarm", 4.5), ("lowarm", "wrist", 3.5),
          ("ball", "toes", 2.5), ("wrist", "middle1", 3.0), ("pinky1", "pinky_null", 0.9),
          ("ring1", "ring_null", 0.9), ("middle1", "middle_null", 0.9),
          ("index1", "index_null", 0.9)]  # fmt: skip
TUBES = [("root", "c_spine1", 14.0), ("c_spine1", "c_spine2", 13.0), ("c_spine2", "c_spine3", 14.0),
         ("c_spine3", "c_neck", 13.0), ("c_neck", "c_head", 6.0), ("c_head", "c_head_null", 8.0),
         *((f"{s}_{a}", f"{s}_{b}", r) for s in "lr" for a, b, r in _LIMBS)]  # fmt: skip
"""Bone whose skin it is, bone at its end, radius in cm."""
END = {bone: PLACES[BONE[end]] if end in BONE else PLACES[BONE[bone]] + [0, -1, 6] for bone, end, _ in TUBES}


def _frames() -> np.ndarray:
    """World axes of every bone at rest: x along it, as MHR's."""
    ends = {**END, "root": PLACES[BONE["c_spine0"]]}
    frames = np.tile(np.eye(3), (len(NAMES), 1, 1))
    for k, name in enumerate(NAMES):
        if name not in ends:
            frames[k] = frames[PARENTS[k]] if PARENTS[k] >= 0 else np.eye(3)
            continue
        x = ends[name] - PLACES[k]
        x /= np.linalg.norm(x)
        z = np.cross(x, [1.0, 0, 0] if abs(x[0]) < 0.5 else [0, 0, -1.0])
        z /= np.linalg.norm(z)
        frames[k] = np.stack([x, np.cross(z, x), z], 1)
    return frames


def _controls(frames: np.ndarray) -> np.ndarray:
    """Seven numbers a bone (translation, Euler angles, binary exponent of the scale) of 204 controls."""
    matrix = np.zeros((len(NAMES), 7, N_CONTROLS + N_SHAPES))
    matrix[BONE["root"], [0, 1, 2], [0, 1, 2]] = 10
    matrix[BONE["root"], [3, 4, 5], [3, 4, 5]] = 1
    for k in range(4):
        matrix[BONE[f"c_spine{k}"], [3, 4, 5], 6 + np.array([0, 2, 4]) + (6 if k else 0)] = 1 / (
            3 if k else 1
        )
    for name, column in (("c_neck", 24), ("c_head", 27)):
        matrix[BONE[name], [3, 4, 5], [column, column + 1, column + 2]] = 1
    for s, column in (("r", 30), ("l", 40)):
        angles = [("clavicle", 3), ("clavicle", 4), ("clavicle", 5), ("uparm", 3), ("uparm", 4), ("uparm", 5),
                  ("lowarm", 5), ("wrist_twist", 3), ("wrist", 4), ("wrist", 5)]  # fmt: skip
        for k, (bone, axis) in enumerate(angles):
            matrix[BONE[f"{s}_{bone}"], axis, column + k] = 1
        for k in range(5):  # a twist grows along the arm
            matrix[BONE[f"{s}_uparm_twist{k}_proc"], 3, column + 3] = k / 5 - 1
    for s, column in (("r", 50), ("l", 59)):
        angles = [("upleg", 3), ("upleg", 4), ("upleg", 5), ("lowleg", 5), ("lowleg", 3), ("foot", 5),
                  ("foot", 4), ("subtalar", 3), ("ball", 5)]  # fmt: skip
        for k, (bone, axis) in enumerate(angles):
            matrix[BONE[f"{s}_{bone}"], axis, column + k] = 1

    def lengthen(bone: str, column: int, way: np.ndarray, share: float = 1.0) -> None:
        local = frames[PARENTS[BONE[bone]]].T @ way
        matrix[BONE[bone], :3, column] = 10 * share * local / np.linalg.norm(way)

    def along(bone: str) -> np.ndarray:
        return PLACES[BONE[bone]] - PLACES[PARENTS[BONE[bone]]]

    for bone in ("c_spine1", "c_spine2", "c_spine3", "c_neck"):
        lengthen(bone, 139, along(bone), 0.25)
    lengthen("c_head", 140, along("c_head"))
    for s, out in (("l", 1.0), ("r", -1.0)):
        lengthen(f"{s}_uparm", 141, np.array([out, 0, 0]))
        lengthen(f"{s}_lowarm", 142, along(f"{s}_lowarm"))
        lengthen(f"{s}_wrist_twist", 143, along(f"{s}_wrist_twist"))
        matrix[BONE[f"{s}_wrist"], 6, 145 if s == "l" else 144] = 1
        for column, way in ((146, [out, 0, 0]), (147, [0, -1.0, 0]), (148, [0, 0, 1.0])):
            lengthen(f"{s}_upleg", column, np.array(way))
        lengthen(f"{s}_lowleg", 149, along(f"{s}_lowleg"))
        lengthen(f"{s}_foot", 150, along(f"{s}_foot"))
        lengthen(f"{s}_talocrural", 152, np.array([0, -1.0, 0]))
        lengthen(f"{s}_ball", 153, along(f"{s}_ball"))
    return matrix.reshape(-1, N_CONTROLS + N_SHAPES)


def _mesh() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (cm), triangles, weights, and every vertex's direction away from its tube's axis."""
    vertices, faces, weights, outward = [], [], [], []
    for bone, _, radius in TUBES:
        a, b = PLACES[BONE[bone]], END[bone]
        x = (b - a) / np.linalg.norm(b - a)
        y = np.cross(x, [0, 0, 1.0] if abs(x[2]) < 0.7 else [1.0, 0, 0])
        y /= np.linalg.norm(y)
        z = np.cross(x, y)
        first = len(vertices)
        for ring, t in enumerate(np.linspace(0, 1, RINGS)):
            for angle in np.arange(CORNERS) * 2 * np.pi / CORNERS:
                away = np.cos(angle) * y + np.sin(angle) * z
                vertices.append(a + t * (b - a) + radius * away)
                outward.append(away)
                row = np.zeros(len(NAMES))
                twist = BONE.get(f"{bone}_twist2_proc")
                row[BONE[bone]] = 1
                if ring == 0:
                    row[[BONE[bone], PARENTS[BONE[bone]]]] = 0.5
                elif ring == 2 and twist is not None:
                    row[[BONE[bone], twist]] = 0.4, 0.6
                weights.append(row)
        for ring in range(RINGS - 1):
            for k in range(CORNERS):
                p, q = first + ring * CORNERS + k, first + ring * CORNERS + (k + 1) % CORNERS
                faces += [[p, q, q + CORNERS], [p, q + CORNERS, p + CORNERS]]
        for rim, flip in ((first, 1), (first + (RINGS - 1) * CORNERS, -1)):
            faces += [[rim, rim + k + 1, rim + k][::flip] for k in range(1, CORNERS - 1)]
    return np.array(vertices), np.array(faces), np.array(weights), np.array(outward)


class MadeRig:
    """The interface of `body_models.mhr.numpy.MHR`, as far as it is used, in double precision."""

    def __init__(self, unit: float = 0.01) -> None:
        """`unit`: metres in one unit of the files."""
        self.unit = unit
        frames = _frames()
        self.base, self.faces, self.skin_weights, outward = _mesh()
        parent = np.array(PARENTS)
        turned = np.where(parent[:, None, None] >= 0, frames[parent], np.eye(3)).transpose(0, 2, 1)
        steps = PLACES - np.where(parent[:, None] >= 0, PLACES[parent], 0)
        self.offsets = np.einsum("jab,jb->ja", turned, steps)
        self.turns = turned @ frames
        self.bind_turns = frames.transpose(0, 2, 1)
        self.bind_shifts = -np.einsum("jba,jb->ja", frames, PLACES)
        self.controls = _controls(frames)
        bulge = 0.1 * np.random.default_rng(5).standard_normal((N_SHAPES, len(TUBES)))  # cm
        self.shapes = np.repeat(bulge, CORNERS * RINGS, axis=1)[:, :, None] * outward
        self.expressions = np.zeros((N_EXPRESSIONS, len(self.base), 3))

    @property
    def joint_names(self) -> list[str]:
        return NAMES

    @property
    def parents(self) -> list[int]:
        return PARENTS

    def get_rest_pose(self, *, hands: str = "default") -> dict[str, Any]:
        sizes = {"shape": 45, "expression": 72, "body_pose": 94, "head_pose": 6, "hand_pose": 104}
        return {name: np.zeros(n) for name, n in sizes.items()}

    def _world(self, pose: dict[str, Any]) -> np.ndarray:
        controls = np.zeros(N_CONTROLS + N_SHAPES)
        controls[BODY_COLUMNS], controls[HEAD_COLUMNS] = pose["body_pose"], pose["head_pose"]
        controls[HAND_COLUMNS] = pose["hand_pose"]
        seven = (self.controls @ controls).reshape(-1, 7)
        world = np.tile(np.eye(4), (len(NAMES), 1, 1))
        turns = Rotation.from_euler("xyz", seven[:, 3:6]).as_matrix() * 2 ** seven[:, 6, None, None]
        for k, parent in enumerate(PARENTS):
            world[k, :3, :3] = self.turns[k] @ turns[k]
            world[k, :3, 3] = self.offsets[k] + seven[k, :3]
            if parent >= 0:
                world[k] = world[parent] @ world[k]
        return world

    def forward_skeleton(self, **pose: Any) -> np.ndarray:
        world = self._world(pose)
        world[:, :3, 3] *= self.unit
        return world

    def forward_vertices(self, **pose: Any) -> np.ndarray:
        world = self._world(pose)
        shaped = self.base + np.einsum("k,kva->va", pose["shape"], self.shapes)
        turn = world[:, :3, :3] @ self.bind_turns
        shift = np.einsum("jab,jb->ja", world[:, :3, :3], self.bind_shifts) + world[:, :3, 3]
        at_bones = np.einsum("jab,vb->vja", turn, shaped) + shift
        return self.unit * np.einsum("vj,vja->va", self.skin_weights, at_bones)

    def write(self, folder: Path) -> None:
        """The three of MHR's files that `body-models` reads: the scripted model's data, correctives."""
        vertex, bone = np.nonzero(self.skin_weights)
        bind = np.c_[self.bind_shifts, Rotation.from_matrix(self.bind_turns).as_quat(), np.ones(len(NAMES))]
        model = {
            "character_torch": {
                "skeleton": {
                    "joint_names": NAMES,
                    "joint_parents": np.array(PARENTS),
                    "joint_translation_offsets": self.offsets,
                    "joint_prerotations": Rotation.from_matrix(self.turns).as_quat(),
                },
                "linear_blend_skinning": {
                    "vert_indices_flattened": vertex,
                    "skin_indices_flattened": bone,
                    "skin_weights_flattened": self.skin_weights[vertex, bone],
                    "inverse_bind_pose": bind,
                },
                "blend_shape": {"base_shape": self.base, "shape_vectors": self.shapes},
                "parameter_transform": {"parameter_transform": self.controls},
                "mesh": {"faces": self.faces},
            },
            "face_expressions_model": {"shape_vectors": self.expressions},
        }
        write_scripted(folder / "mhr_model.pt", model)
        np.savez(
            folder / "corrective_activation.npz",
            **{
                "0.sparse_indices": np.zeros((2, 1), dtype=np.int64),
                "0.sparse_weight": np.zeros(1, np.float32),
            },
        )
        none = np.zeros((3000, len(self.base), 3), dtype=np.float32)
        np.savez_compressed(folder / "corrective_blendshapes_lod1.npz", corrective_blendshapes=none)


class _Named:
    """A class that the pickle names without having it."""

    def __init__(self, module: str, name: str) -> None:
        self.module, self.name = module, name


class _Array:
    def __init__(self, array: np.ndarray, key: str) -> None:
        self.array, self.key = array, key


class _ScriptedPickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    """The pickle inside a TorchScript file: modules as objects of unknown classes, tensors as storages."""

    def save(self, value: Any, save_persistent_id: bool = True) -> None:
        if isinstance(value, _Named):
            self.write(pickle.GLOBAL + f"{value.module}\n{value.name}\n".encode())
        elif isinstance(value, _Array):
            kind = "LongStorage" if value.array.dtype == np.int64 else "FloatStorage"
            size = value.array.size
            self.save(_Named("torch._utils", "_rebuild_tensor_v2"))
            self.write(pickle.MARK)
            self.save_plain(("storage", _Named("torch", kind), value.key, "cpu", size))
            self.write(pickle.BINPERSID)
            shape = value.array.shape
            strides = tuple(int(np.prod(shape[k + 1 :])) for k in range(len(shape)))
            for part in (0, shape, strides, False, None):
                self.save(part)
            self.write(pickle.TUPLE + pickle.REDUCE)
        elif isinstance(value, dict):
            self.save(_Named("__torch__.made", "Module"))
            self.write(pickle.EMPTY_TUPLE + pickle.NEWOBJ + pickle.EMPTY_DICT + pickle.MARK)
            for key, part in value.items():
                self.save(key)
                self.save(part)
            self.write(pickle.SETITEMS + pickle.BUILD)
        else:
            super().save(value, save_persistent_id)

    def save_plain(self, parts: tuple[Any, ...]) -> None:
        self.write(pickle.MARK)
        for part in parts:
            self.save(part)
        self.write(pickle.TUPLE)


def write_scripted(path: Path, content: dict[str, Any]) -> None:
    """A zip as TorchScript writes: data.pkl, the storages, constants.pkl."""
    storages: list[np.ndarray] = []

    def stored(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: stored(part) for key, part in value.items()}
        if isinstance(value, np.ndarray):
            kind = np.int64 if value.dtype.kind == "i" else np.float32
            storages.append(np.ascontiguousarray(value, dtype=kind))
            return _Array(storages[-1], str(len(storages) - 1))
        return value

    stream = io.BytesIO()
    _ScriptedPickler(stream, 2).dump(stored(content))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mhr_model/data.pkl", stream.getvalue())
        archive.writestr("mhr_model/constants.pkl", pickle.dumps((), 2))
        for key, storage in enumerate(storages):
            archive.writestr(f"mhr_model/data/{key}", storage.tobytes())
