"""The template: a half mesh of the average body, exactly 6890 vertices once mirrored.

Marching cubes on a grid graded in x, y and z, then remeshing to a size field that is fine at hands, feet and
face.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from skimage.measure import marching_cubes

from .anatomy import make_person
from .anthropometry import measure
from .foot import foot_of, toe_gaps
from .hand import Hand, hand_of
from .head import Head, feature_lines, head_of
from .implicit import ImplicitBody
from .plan import plan
from .ramp import smooth_step
from .remesh import OFF_SEAM_M, SEAM_TOLERANCE_M, Remesher
from .skeleton import JOINT

N_VERTICES = 6890
DECIMALS = 7  # of the shipped mesh: a tenth of a micrometre
# Edge lengths by place; the body's is the price of the face's.
TRUNK_EDGE_M, PALM_EDGE_M, FINGER_EDGE_M, TIP_EDGE_M = 0.0252, 0.0110, 0.0073, 0.0060
HEEL_EDGE_M, TOE_EDGE_M = 0.0165, 0.0068
SKULL_EDGE_M, FACE_EDGE_M = 0.0175, 0.0095
REACH_OF_LINES_M = 0.004
SNAP = 0.4  # of an edge length: vertices as near as this to a feature line lie on it
FACE_DETAIL = (  # place (see `head`), reach in x, y, z, edge length there
    ((0.0320, 0.500, 0.078), (0.020, 0.014, 0.020), 0.0042),  # eye
    ((0.0000, 0.196, 0.098), (0.030, 0.013, 0.020), 0.0045),  # mouth
    ((0.0000, 0.330, 0.105), (0.020, 0.012, 0.016), 0.0050),  # tip of the nose
    ((0.0760, 0.445, -0.0130), (0.020, 0.034, 0.022), 0.0057),  # ear
)


def graded_axis(runs: Iterable[tuple[float, float, float]]) -> Float[np.ndarray, "n"]:
    """Grid planes from (start, end, spacing) runs that follow one another."""
    runs = list(runs)
    planes = [np.array([runs[0][0]])]
    for start, end, spacing in runs:
        planes.append(np.linspace(start, end, max(round((end - start) / spacing), 1) + 1)[1:])
    return np.concatenate(planes)


def march(
    body: ImplicitBody, axes: tuple[np.ndarray, ...]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Zero level set on a rectilinear grid; open at x = 0."""
    value = np.full([len(a) for a in axes], body.FAR_M)
    for primitive, is_cut in zip(body.primitives, body.is_cut, strict=True):
        margin = body.REACH_M + primitive.blend_m
        box = tuple(
            slice(*np.searchsorted(a, (primitive.low[i] - margin, primitive.high[i] + margin)))
            for i, a in enumerate(axes)
        )
        corners = np.stack(np.meshgrid(*[a[s] for a, s in zip(axes, box, strict=True)], indexing="ij"), -1)
        if corners.size:
            distance = primitive.distance(corners.reshape(-1, 3)).reshape(corners.shape[:3])
            value[box] = body.join(value[box], distance, primitive, is_cut)
    vertices, faces, _, _ = marching_cubes(value, 0.0)
    vertices = np.stack([np.interp(vertices[:, i], np.arange(len(a)), a) for i, a in enumerate(axes)], 1)
    return vertices, faces.astype(np.int64)


def weld(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], tolerance_m: float = 1e-7
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Merge coincident vertices, drop degenerate faces, keep the largest component."""
    key = np.round(vertices / tolerance_m).astype(np.int64)
    _, first, inverse = np.unique(key, axis=0, return_index=True, return_inverse=True)
    v, f = vertices[first], inverse.ravel()[faces]
    f = f[(f[:, 0] != f[:, 1]) & (f[:, 1] != f[:, 2]) & (f[:, 2] != f[:, 0])]
    e = np.concatenate([f[:, :2], f[:, 1:]])
    graph = coo_matrix((np.ones(len(e)), (e[:, 0], e[:, 1])), (len(v),) * 2)
    _, label = connected_components(graph, directed=False)
    keep = label == np.bincount(label[f[:, 0]]).argmax()
    new = np.cumsum(keep) - 1
    return v[keep], new[f[keep[f[:, 0]]]]


def wanted_edge(
    head: Head, hand: Hand, joints: Float[np.ndarray, "24 3"]
) -> Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, "n"]]:
    """Edge length in metres by place, as the constants above say."""
    wrist_x = float(joints[JOINT["left_wrist"], 0])
    toes_z = float(joints[JOINT["left_foot"], 2])
    tips = hand.tips()
    centres = np.stack([head.at(*place) for place, _, _ in FACE_DETAIL])

    def wanted(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
        x, y, z = points.T
        edge = TRUNK_EDGE_M + (PALM_EDGE_M - TRUNK_EDGE_M) * smooth_step(wrist_x - 0.09, wrist_x + 0.03, x)
        edge += (FINGER_EDGE_M - PALM_EDGE_M) * smooth_step(wrist_x + 0.05, wrist_x + 0.09, x)
        from_tip = np.linalg.norm(points[:, None] - tips, axis=2).min(1)
        edge = np.minimum(edge, TIP_EDGE_M + (edge - TIP_EDGE_M) * smooth_step(0.008, 0.025, from_tip))
        foot = HEEL_EDGE_M + (TOE_EDGE_M - HEEL_EDGE_M) * smooth_step(toes_z - 0.02, toes_z + 0.025, z)
        edge = np.minimum(edge, TRUNK_EDGE_M + (foot - TRUNK_EDGE_M) * smooth_step(0.16, 0.03, y))
        in_face = smooth_step(0.01, 0.06, z) * smooth_step(
            head.chin + 0.85 * head.height, head.chin + 0.6 * head.height, y
        )
        on_head = SKULL_EDGE_M + (FACE_EDGE_M - SKULL_EDGE_M) * in_face
        for centre, (_, reach_m, edge_m) in zip(centres, FACE_DETAIL, strict=True):
            away = np.sqrt((((points - centre) / reach_m) ** 2).sum(1))
            on_head = np.minimum(on_head, edge_m + (on_head - edge_m) * smooth_step(0.7, 2.0, away))
        in_head = smooth_step(head.chin - 0.10, head.chin - 0.02, y) * (x < 0.25)
        return np.minimum(edge, TRUNK_EDGE_M + (on_head - TRUNK_EDGE_M) * in_head)

    return wanted


def settle_count(mesh: Remesher, target: int) -> None:
    """Single collapses and splits until the mirrored count is met (a seam edge: 1 vertex, another: 2)."""
    for _ in range(400):
        n = mesh.n_mirrored()
        if n == target:
            return
        if n > target:
            for a, b in sorted(mesh.edges(), key=lambda e: (mesh.relative_length(e), e)):
                if (n - target == 1) == (mesh.seam[a] and mesh.seam[b]) and mesh.collapse(a, b):
                    break
        else:
            for a, b in sorted(mesh.edges(), key=lambda e: (-mesh.relative_length(e), e)):
                if (target - n == 1) == (len(mesh.around[a] & mesh.around[b]) == 1):
                    mesh.split(a, b)
                    break
    raise AssertionError(f"remeshing stopped at {mesh.n_mirrored()} vertices instead of {target}")


def on_skin(
    body: ImplicitBody, line: Float[np.ndarray, "k 3"], axis: int, n: int = 40
) -> Float[np.ndarray, "n 3"]:
    """A polyline near the skin, resampled and moved along a coordinate axis onto the skin, its high end."""
    station = np.linspace(0, len(line) - 1, n)
    p = np.stack([np.interp(station, np.arange(len(line)), line[:, i]) for i in range(3)], 1)
    depth = np.linspace(-0.03, 0.03, 241)
    column = p[:, None] + depth[None, :, None] * np.eye(3)[axis]
    value = body(column.reshape(-1, 3)).reshape(n, -1)
    outermost = value.shape[1] - 1 - (value[:, ::-1] < 0).argmax(1)
    p[:, axis] += depth[outermost]
    return p[(value < 0).any(1)]


def pull_to_lines(
    points: Float[np.ndarray, "n 3"],
    on_seam: np.ndarray,
    size: Float[np.ndarray, "n"],
    lines: Sequence[Float[np.ndarray, "_ 3"]],
) -> Float[np.ndarray, "n 3"]:
    """Vertices within SNAP edge lengths of a line move onto it, so that edges run along lids and lips."""
    p = points.copy()
    low = np.stack([line.min(0) for line in lines]) - REACH_OF_LINES_M
    high = np.stack([line.max(0) for line in lines]) + REACH_OF_LINES_M
    in_box = np.all((p[:, None] > low) & (p[:, None] < high), axis=2)
    near = np.flatnonzero(in_box.any(axis=1))
    best, target = np.full(len(near), np.inf), p[near].copy()
    for line in lines:
        for a, b in itertools.pairwise(line):
            h = np.clip((p[near] - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            foot = a + h[:, None] * (b - a)
            away = np.linalg.norm(p[near] - foot, axis=1)
            closer = away < best
            best[closer], target[closer] = away[closer], foot[closer]
    pulled = best < SNAP * size[near]
    pulled &= ~on_seam[near] | (target[:, 0] < 1e-4)
    p[near[pulled]] = target[pulled]
    p[on_seam, 0] = 0
    p[~on_seam, 0] = np.maximum(p[~on_seam, 0], OFF_SEAM_M)
    return p


def make_half_mesh(
    progress: Callable[[], object] = lambda: None,
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"]]:
    """Half mesh of the average body (sex 0.5, civilian BMI), floor frame; `progress` is called N_ROUNDS
    times.
    """
    person = measure(0.5)
    body, joints = make_person(person)
    stature, shoulder_y, wrist_x = (
        person.stature,
        joints[JOINT["left_shoulder"], 1],
        joints[JOINT["left_wrist"], 0],
    )
    own_plan = plan(person)
    head = head_of(own_plan)
    axes = (
        graded_axis(
            [(0.0, 0.16, 0.008), (0.16, wrist_x - 0.02, 0.011), (wrist_x - 0.02, wrist_x + 0.24, 0.0032)]
        ),
        graded_axis(
            [
                (-0.012, 0.03, 0.004),
                (0.03, 0.10, 0.006),
                (0.10, shoulder_y - 0.05, 0.011),
                (shoulder_y - 0.05, shoulder_y + 0.03, 0.0035),
                (shoulder_y + 0.03, stature - 0.24, 0.008),
                (stature - 0.24, stature + 0.02, 0.0055),
            ]
        ),
        graded_axis([(-0.22, -0.06, 0.009), (-0.06, 0.12, 0.0042), (0.12, 0.30, 0.006)]),
    )
    v, f = march(body, axes)
    v[v[:, 0] < 1e-7, 0] = 0
    v, f = weld(np.round(v, 6), f)
    progress()

    wanted = wanted_edge(head, hand_of(own_plan), joints)
    size_factor = 1.03
    lines = [on_skin(body, line, axis=2) for line in feature_lines(head)]
    lines += [on_skin(body, line, axis=1) for line in toe_gaps(foot_of(own_plan))]

    def settle(points: np.ndarray, on_seam: np.ndarray) -> np.ndarray:
        points = body.project(points, on_seam=on_seam, steps=1)
        return pull_to_lines(points, on_seam, size_factor * wanted(points), lines)

    mesh = Remesher(v, f, lambda p: size_factor * wanted(p), settle)
    for round_idx in range(N_ROUNDS - 2):
        if round_idx:
            mesh.split_pass(1.4)
        mesh.collapse_pass(0.72 if round_idx else 0.82)
        mesh.flip_pass()
        mesh.flip_pass()
        mesh.relax(2)
        if round_idx >= 2:
            size_factor = round(size_factor * (mesh.n_mirrored() / N_VERTICES) ** 0.5, 6)
        mesh.load(*mesh.arrays())
        progress()
    settle_count(mesh, N_VERTICES)
    for _ in range(4):
        mesh.flip_pass()
        mesh.relax(3)
    v, f = mesh.arrays()
    progress()
    return body.project(v, on_seam=v[:, 0] < SEAM_TOLERANCE_M, steps=3), f


N_ROUNDS = 10
STORED = "half_mesh.npz"


def load_half_mesh() -> tuple[Float[np.ndarray, "h 3"], Int[np.ndarray, "g 3"]]:
    """The half mesh as shipped: what `make_half_mesh` gave, so that every machine numbers vertices alike and
    none has to remesh. `python -m fit.body.half_mesh` writes it anew after the anatomy has changed."""
    with resources.files(__package__).joinpath(STORED).open("rb") as stream:
        stored = np.load(stream, allow_pickle=False)
        return stored["vertices"], stored["faces"].astype(np.int64)


def write_half_mesh() -> None:
    """Remesh the average body and keep the result beside this file."""
    vertices, faces = make_half_mesh()
    path = Path(__file__).with_name(STORED)
    np.savez_compressed(path, vertices=np.round(vertices, DECIMALS), faces=faces.astype(np.uint16))


def mirror(
    v: Float[np.ndarray, "h 3"], f: Int[np.ndarray, "g 3"]
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "f 3"], Int[np.ndarray, "v"]]:
    """Whole body from the half (its vertices first): vertices, faces, and every vertex's partner."""
    seam = v[:, 0] < SEAM_TOLERANCE_M
    n = len(v)
    partner = np.arange(n)
    partner[~seam] = n + np.arange((~seam).sum())
    whole = np.concatenate([v, v[~seam] * [-1, 1, 1]])
    whole[:n][seam, 0] = 0
    faces = np.concatenate([f, partner[f][:, ::-1]])
    return whole, faces, np.concatenate([partner, np.flatnonzero(~seam)])


if __name__ == "__main__":
    write_half_mesh()
