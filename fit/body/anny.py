"""ANNY (Bregier et al. 2025; assets CC0) as a body of SMPL's structure, through the optional `body-models`.

Offline where its assets are: a folder with data/mpfb2 in it, such as the package `anny` brings. Only grown
people are drawn. Gender is one of ANNY's own shape parameters and ends up among the components.
"""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from .body_archive import BodyModelError
from .body_file import BodyFile
from .foreign_shapes import DrawnPeople, body_of_people, fold_by_name, triangles
from .skeleton import JOINT_NAMES

N_PEOPLE = 200
N_BETAS = 20
LICENCE = "CC0-1.0 (ANNY's assets)"
ADULT_AGES = (0.60, 0.90)  # ANNY's scale: child 1/3, young 2/3, old 1
MUSCLE_WEIGHT_PROPORTIONS = (0.5, 0.17)  # mean, SD on ANNY's scales of 0 to 1
HEIGHT = (0.38, 0.08)  # about 1.70 m: at 0.5 its people are 1.83 m tall, and a tenth is some 11 cm
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from ANNY's z up, facing -y
_SIDED = {
    "upperleg01": "hip", "lowerleg01": "knee", "foot": "ankle", "clavicle": "collar",
    "upperarm01": "shoulder", "lowerarm01": "elbow", "wrist": "wrist",
    **{f"toe{k}-1": "foot" for k in (3, 1, 2, 4, 5)}, **{f"finger{k}-1": "hand" for k in (3, 2, 4, 5)},
}  # fmt: skip
JOINT_OF_BONE: dict[str, str] = {
    "root": "pelvis", "spine05": "pelvis", "spine04": "spine1", "spine03": "spine2", "spine02": "spine3",
    "neck01": "neck", "head": "head",
    **{f"{bone}.L": f"left_{joint}" for bone, joint in _SIDED.items()},
    **{f"{bone}.R": f"right_{joint}" for bone, joint in _SIDED.items()},
}  # fmt: skip
"""ANNY's bone -> SMPL's joint; the first bone of a joint says where the joint lies."""


def anny_body_file(assets: Path | None = None, *, seed: int = 0, show_progress: bool = True) -> BodyFile:
    """ANNY as a body file. `assets`: folder with data/mpfb2; None: where body-models keeps (or fetches) it.

    Raises BodyModelError where body-models is not installed or the assets are not there.
    """
    try:
        from body_models.anny.numpy import ANNY
    except ImportError as error:
        raise BodyModelError(
            f"anny: needs the package body-models ({error}). Install it: pip install 'bodyhull[bodies]'"
        ) from error
    try:
        model = ANNY(model_path=assets)
    except Exception as error:  # a download that fails raises whatever it likes
        raise BodyModelError(
            f"anny: its assets cannot be had ({type(error).__name__}: {str(error)[:120]}). "
            f"Give their folder: anny:FOLDER, with data/mpfb2 in it."
        ) from error
    random = np.random.default_rng(seed)
    bones = list(model.joint_names)
    first = [next(bone for bone, own in JOINT_OF_BONE.items() if own == name) for name in JOINT_NAMES]
    at = [bones.index(bone) for bone in first]
    pose = model.get_tpose(hands="flat")
    vertices, joints = [], []
    for _ in tqdm(range(N_PEOPLE), desc="drawing ANNY's people", disable=not show_progress):
        muscle, weight, proportions = random.normal(*MUSCLE_WEIGHT_PROPORTIONS, 3)
        drawn = [muscle, weight, random.normal(*HEIGHT), proportions]
        pose["shape"] = np.array([random.uniform(), random.uniform(*ADULT_AGES), *np.clip(drawn, 0.02, 0.98)])
        vertices.append(np.asarray(model.forward_vertices(**pose), dtype=np.float64) @ Y_UP.T)
        joints.append(np.asarray(model.forward_skeleton(**pose), dtype=np.float64)[at, :3, 3] @ Y_UP.T)
    faces = triangles(np.asarray(model.faces, dtype=np.int64))
    used, index = np.unique(faces, return_inverse=True)
    folded = fold_by_name(bones, list(model.parents), JOINT_OF_BONE)
    weights = np.zeros((len(used), len(JOINT_NAMES)))
    np.add.at(weights.T, folded, np.asarray(model.skin_weights, dtype=np.float64)[used].T)
    people = DrawnPeople(
        name="anny",
        licence=LICENCE,
        gender="neutral",
        vertices=np.stack(vertices)[:, used],
        joints=np.stack(joints),
        faces=index.reshape(faces.shape),
        weights=weights / weights.sum(1, keepdims=True),
    )
    return body_of_people(people, N_BETAS)
