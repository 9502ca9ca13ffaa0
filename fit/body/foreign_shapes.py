"""Another body model made into one of SMPL's structure, from its own people in the T-pose.

Shape space: principal components of many people drawn from the other model, one standard deviation long.
Weights: folded to 24 joints by a map of names, each unnamed bone with its nearest named ancestor. Joints:
regressed from the vertices around them, over the same people. Correctives are zero: such a body bends by
linear blend skinning alone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from .body_file import BodyFile
from .joint_trees import TREES
from .skeleton import JOINT, N_JOINTS

N_AROUND = 60  # vertices that a joint is regressed from
EVENNESS = 1e-5  # pulls a joint's weights towards equal shares, against their fit in metres squared
SUM_TO_ONE = 1e3


@dataclass(frozen=True)
class DrawnPeople:
    """N people of another model in the T-pose: metres, y up, +z front, +x the body's left."""

    name: str
    licence: str
    gender: str
    vertices: Float[np.ndarray, "n v 3"]
    joints: Float[np.ndarray, "n 24 3"]
    """Where SMPL's joints lie in each."""
    faces: Int[np.ndarray, "f 3"]
    weights: Float[np.ndarray, "v 24"]


def fold_by_name(
    bones: Sequence[str], parents: Sequence[int], joint_of_bone: Mapping[str, str]
) -> Int[np.ndarray, "b"]:
    """For every bone the SMPL joint that stands for it: its own in `joint_of_bone`, else its nearest named
    ancestor's. Raises KeyError where the root is not named."""
    joint: list[int] = []
    for bone, parent in zip(bones, parents, strict=True):
        named = joint_of_bone[bone] if parent < 0 else joint_of_bone.get(bone)
        joint.append(joint[parent] if named is None else JOINT[named])
    return np.array(joint)


def triangles(faces: Int[np.ndarray, "f k"]) -> Int[np.ndarray, "t 3"]:
    """Triangles of polygons with equally many corners (a triangle repeats its last corner in quads)."""
    fans = [faces[:, [0, k, k + 1]] for k in range(1, faces.shape[1] - 1)]
    cut = np.concatenate(fans)
    return cut[(cut[:, 0] != cut[:, 1]) & (cut[:, 1] != cut[:, 2]) & (cut[:, 0] != cut[:, 2])]


def body_of_people(people: DrawnPeople, n_betas: int) -> BodyFile:
    """A body file of SMPL's structure; the note says how much of the people's variation it keeps."""
    n, v = people.vertices.shape[:2]
    assert 0 < n_betas < n, "components come from more people than there are components"
    mean = people.vertices.mean(0)
    spread = (people.vertices - mean).reshape(n, -1)
    variance, mixing = np.linalg.eigh(spread @ spread.T / (n - 1))
    variance, mixing = variance[::-1][:n_betas], mixing[:, ::-1][:, :n_betas]
    directions = spread.T @ mixing / np.sqrt(n - 1)  # each one standard deviation long
    kept = variance.sum() / max(float((spread**2).sum() / (n - 1)), 1e-30)
    lost = spread - mixing @ (mixing.T @ spread)
    rms_mm = 1e3 * float(np.sqrt((lost**2).sum() / (n * v)))
    regressor = np.stack(
        [_regress(people.vertices, people.joints[:, j], mean) for j in range(people.joints.shape[1])]
    )
    off_mm = 1e3 * np.linalg.norm(
        np.einsum("jv,nva->nja", regressor, people.vertices) - people.joints, axis=2
    )
    return BodyFile(
        name=people.name,
        licence=people.licence,
        kind="SMPL",
        gender=people.gender,
        template=mean,
        faces=people.faces,
        shape_directions=directions.reshape(v, 3, n_betas),
        expression_directions=np.zeros((v, 3, 0)),
        pose_directions=np.zeros((v, 3, 9 * (N_JOINTS - 1))),
        weights=people.weights,
        joint_regressor=regressor,
        parents=np.array(TREES["SMPL"]),
        notes=(
            f"{n_betas} components of {n} people keep {100 * kept:.1f} % of their variance "
            f"({rms_mm:.2f} mm RMS lost); joints regressed within {off_mm.mean():.2f} mm",
        ),
    )


def _regress(
    vertices: Float[np.ndarray, "n v 3"], joint: Float[np.ndarray, "n 3"], mean: Float[np.ndarray, "v 3"]
) -> Float[np.ndarray, "v"]:
    """Weights of vertices that place a joint in every person, summing to one: ridge least squares."""
    _, near = cKDTree(mean).query(joint.mean(0), k=min(N_AROUND, len(mean)))
    k = len(near)
    a = vertices[:, near].transpose(0, 2, 1).reshape(-1, k)
    ridge = np.sqrt(EVENNESS) * np.eye(k)
    system = np.concatenate([a, ridge, np.full((1, k), SUM_TO_ONE)])
    wanted = np.concatenate([joint.reshape(-1), ridge @ np.full(k, 1 / k), [SUM_TO_ONE]])
    solved = np.linalg.lstsq(system, wanted, rcond=None)[0]
    row = np.zeros(len(mean))
    row[near] = solved / solved.sum()
    return row
