"""A tape around a finished mesh: girths, volume and extents as an anthropometrist would read them.

Standing T-pose, y up, metres. A girth is the convex perimeter of a plane section, as a tape bridges hollows.
Levels are fixed fractions of the average body's stature, near the survey's landmarks (Gordon et al. 2014).
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import ConvexHull

from .skeleton import JOINT

WATER_KG_PER_LITRE = 1.0  # whole-body density is 0.98 to 1.06: litres read as kilograms within a few per cent


def volume_m3(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Enclosed volume of a closed mesh with outward faces."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ia,ia->", a, np.cross(b, c)) / 6)


def girth(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    point: Float[np.ndarray, "3"],
    normal: Float[np.ndarray, "3"],
    keep: Callable[[Float[np.ndarray, "n 3"]], np.ndarray],
) -> float:
    """Convex perimeter of the section through `point` across `normal`, of those section points that `keep`
    accepts.

    Raises ValueError where the plane misses the mesh or `keep` leaves fewer than three points.
    """
    n = normal / np.linalg.norm(normal)
    height = (vertices - point) @ n
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    a, b = height[edges[:, 0]], height[edges[:, 1]]
    crossing = (a > 0) != (b > 0)
    t = (a[crossing] / (a[crossing] - b[crossing]))[:, None]
    p = vertices[edges[crossing, 0]] * (1 - t) + vertices[edges[crossing, 1]] * t
    p = p[keep(p)]
    if len(p) < 3:
        raise ValueError("girth: the plane does not cut the part of the body that was asked for.")
    in_plane = np.linalg.svd(n[None])[2][1:]
    return float(ConvexHull(p @ in_plane.T).area)


def girths(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    joints: Float[np.ndarray, "24 3"],
    level: Callable[[float], float],
) -> dict[str, float]:
    """The eleven girths of `anthropometry.GIRTHS` on a body in the T-pose.

    `level` turns a fraction of stature into this body's height (`anatomy.height_map`, in the frame of the
    vertices).
    """
    shoulder, elbow, wrist = (joints[JOINT[name]] for name in ("left_shoulder", "left_elbow", "left_wrist"))
    up, along_arm = np.array([0.0, 1.0, 0.0]), wrist - shoulder
    neck_normal = np.array([0.0, 0.88, 0.47])  # the neck leans forward, and the tape with it

    def trunk(p: Float[np.ndarray, "n 3"]) -> np.ndarray:
        return np.abs(p[:, 0]) < shoulder[0] + 0.06

    def leg(p: Float[np.ndarray, "n 3"]) -> np.ndarray:
        return p[:, 0] > 0.002

    def arm(p: Float[np.ndarray, "n 3"]) -> np.ndarray:
        return p[:, 0] > shoulder[0]

    def at(fraction: float, keep: Callable[[np.ndarray], np.ndarray]) -> float:
        return girth(vertices, faces, np.array([0, level(fraction), 0]), up, keep)

    def forearm(share: float) -> float:
        return girth(vertices, faces, elbow + share * (wrist - elbow), along_arm, arm)

    def neck(fraction: float) -> float:
        point = np.array([0, level(fraction), -0.02])
        return girth(vertices, faces, point, neck_normal, lambda p: np.linalg.norm(p - point, axis=1) < 0.11)

    return {
        "neck": min(neck(f) for f in (0.855, 0.865, 0.872, 0.880)),
        "chest": at(0.733, trunk),
        "waist": at(0.602, trunk),
        "hip": at(0.508, trunk),
        "thigh": at(0.450, leg),
        "knee": girth(vertices, faces, joints[JOINT["left_knee"]], up, leg),
        "calf": max(at(f, leg) for f in (0.19, 0.20, 0.21, 0.22)),
        "ankle": min(at(f, leg) for f in (0.06, 0.07, 0.08, 0.09)),
        "biceps": girth(vertices, faces, 0.5 * (shoulder + elbow), along_arm, arm),
        "forearm": max(forearm(s) for s in (0.2, 0.3)),
        "wrist": min(forearm(s) for s in (0.90, 0.95, 1.0)),
    }
