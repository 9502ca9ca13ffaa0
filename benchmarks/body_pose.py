"""How well the free body keeps its volume in bends, and how fast it is posed beside `body-models`.

    python -m benchmarks.body_pose                    # both tables
    python -m benchmarks.body_pose --volume           # volume kept, three sexes, mean and +-2 SD of weight
    python -m benchmarks.body_pose --speed            # forward and Jacobian; theirs where it is installed

Volume is counted of the whole body and of the segment around the joint alone (its part labels, closed by a
fan over each open end), because the whole hides a pinch. A second table tells the space that the body fills
in deep bends: there belly and thigh overlap, which the signed volume of the first counts twice. Times are the
least of the repetitions, both libraries in one process and in double precision.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from fit.body import BodyModel, load_body, shape_space
from fit.body.segments import Segment
from fit.body.skeleton import JOINT, N_JOINTS, axis_angle_to_matrix, blend_linearly, world_from_rest

Turns = dict[str, tuple[float, float, float]]

ARM = ("left_collar", "left_shoulder", "left_elbow")
LOWER_ARM = ("left_elbow", "left_wrist")
TRUNK = ("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
#: Name, turns in degrees (a bare joint name turns both sides), parts of the segment.
BENDS: tuple[tuple[str, Turns, tuple[str, ...]], ...] = (
    ("hip flexed 60", {"left_hip": (-60, 0, 0)}, ("pelvis", "left_hip")),
    ("hip flexed 110", {"left_hip": (-110, 0, 0)}, ("pelvis", "left_hip")),
    ("hip abducted 35", {"left_hip": (0, 0, 35)}, ("pelvis", "left_hip")),
    ("hip extended 20", {"left_hip": (20, 0, 0)}, ("pelvis", "left_hip")),
    ("knee 70", {"left_knee": (70, 0, 0)}, ("left_hip", "left_knee")),
    ("knee 110", {"left_knee": (110, 0, 0)}, ("left_hip", "left_knee")),
    ("knee 140", {"left_knee": (140, 0, 0)}, ("left_hip", "left_knee")),
    ("ankle down 40", {"left_ankle": (40, 0, 0)}, ("left_knee", "left_ankle", "left_foot")),
    ("ankle up 20", {"left_ankle": (-20, 0, 0)}, ("left_knee", "left_ankle", "left_foot")),
    ("shoulder down", {"left_collar": (0, 0, -5), "left_shoulder": (0, 0, -75)}, (*TRUNK[2:], *ARM)),
    ("shoulder overhead", {"left_collar": (0, 0, 26), "left_shoulder": (0, 0, 62)}, (*TRUNK[2:], *ARM)),
    ("shoulder forward", {"left_collar": (0, -13, 0), "left_shoulder": (0, -85, 0)}, (*TRUNK[2:], *ARM)),
    ("elbow 70", {"left_elbow": (0, -70, 0)}, ("left_shoulder", "left_elbow")),
    ("elbow 110", {"left_elbow": (0, -110, 0)}, ("left_shoulder", "left_elbow")),
    ("elbow 140", {"left_elbow": (0, -140, 0)}, ("left_shoulder", "left_elbow")),
    ("forearm twist +80", {"left_elbow": (25, 0, 0), "left_wrist": (55, 0, 0)}, LOWER_ARM),
    ("forearm twist -80", {"left_elbow": (-25, 0, 0), "left_wrist": (-55, 0, 0)}, LOWER_ARM),
    ("wrist flexed 60", {"left_wrist": (0, 0, -60)}, ("left_elbow", "left_wrist")),
    ("wrist extended 60", {"left_wrist": (0, 0, 60)}, ("left_elbow", "left_wrist")),
    ("spine flexed 60", {f"spine{i}": (20, 0, 0) for i in (1, 2, 3)}, TRUNK),
    ("spine bent 30", {f"spine{i}": (0, 0, 10) for i in (1, 2, 3)}, TRUNK),
    ("spine turned 42", {f"spine{i}": (0, 14, 0) for i in (1, 2, 3)}, TRUNK),
    ("neck flexed 45", {"neck": (22, 0, 0), "head": (23, 0, 0)}, ("spine3", "neck", "head")),
    ("neck turned 70", {"neck": (0, 30, 0), "head": (0, 40, 0)}, ("spine3", "neck", "head")),
    ("squat", {"hip": (-105, 12, 16), "knee": (120, 0, 0), "ankle": (-20, 0, 0), "spine1": (8, 0, 0),
               "spine2": (8, 0, 0), "shoulder": (0, -65, -12)}, ()),
    ("sit", {"hip": (-88, 0, 4), "knee": (90, 0, 0), "collar": (0, 0, -5), "shoulder": (0, 0, -70),
             "elbow": (0, -80, 0)}, ()),
    ("walk", {"left_hip": (-30, 0, 0), "right_hip": (18, 0, 0), "left_knee": (15, 0, 0),
              "right_knee": (50, 0, 0), "left_shoulder": (25, 5, -65), "right_shoulder": (-20, 0, 65),
              "elbow": (0, -30, 0)}, ()),
    ("arms overhead", {"collar": (0, 0, 26), "shoulder": (0, 0, 62)}, ()),
)  # fmt: skip


DEEP_BENDS = ("hip flexed 110", "knee 140", "elbow 140", "spine flexed 60", "squat", "sit")


def pose_of(turns: Turns) -> np.ndarray:
    """Rotation vectors (24 3), rad."""
    pose = np.zeros((N_JOINTS, 3))
    for name, turn in turns.items():
        if name in JOINT:
            pose[JOINT[name]] = np.radians(turn)
        else:
            pose[JOINT[f"left_{name}"]] = np.radians(turn)
            pose[JOINT[f"right_{name}"]] = np.radians(turn) * [1, -1, -1]
    return pose


def posed(model: BodyModel, template: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Skinned vertices (V 3) of this template, correctives and all, in plain numpy."""
    rotations = axis_angle_to_matrix(pose)
    corrected = template + model.pose_directions @ (rotations[1:] - np.eye(3)).ravel()
    bones = world_from_rest(rotations, model.joint_regressor @ template)
    return blend_linearly(corrected, model.weights, bones)[0]


def segment_of(model: BodyModel, parts: tuple[str, ...]) -> Segment:
    """The segment of these parts; the whole body where none is named."""
    return Segment.of(model.faces, np.isin(model.parts, [JOINT[p] for p in parts]) | (not parts))


def union_volume_m3(vertices: np.ndarray, faces: np.ndarray, step_m: float = 0.003) -> float:
    """Volume of the space a closed mesh fills, overlaps once, by upright columns a step apart."""
    corners = vertices[faces]
    flat = corners[:, :, [2, 0]] / step_m + 0.137  # off the grid, or columns would hit vertices of the seam
    low, high = np.ceil(flat.min(1)).astype(int), np.floor(flat.max(1)).astype(int)
    n = np.maximum(high - low + 1, 0)
    face = np.repeat(np.arange(len(faces)), n.prod(1))
    k = np.arange(len(face)) - np.repeat(np.cumsum(n.prod(1)) - n.prod(1), n.prod(1))
    column = low[face] + np.stack([k // n[face, 1], k % n[face, 1]], 1)
    a, b, c = (flat[face, i] - column for i in range(3))
    share = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))], 1)
    hit = (share > 0).all(1) | (share < 0).all(1)
    face, column, share = face[hit], column[hit], share[hit]
    area = share.sum(1)
    height = (share * corners[face, :, 1]).sum(1) / area
    order = np.lexsort((height, column[:, 1], column[:, 0]))
    column, height = column[order], height[order]
    inside = np.cumsum(-np.sign(area[order]))[:-1] > 0.5
    same = (column[1:] == column[:-1]).all(1)
    return float(np.diff(height)[same & inside].sum() * step_m**2)


def weight_component(model: BodyModel) -> int:
    """The shape component that a person would call weight."""
    anthropometric = model.shape_directions[:, :, : model.n_anthropometric]
    return shape_space.weight_component(model.template, anthropometric, model.faces)


def kept_volume(model: BodyModel, betas: np.ndarray) -> list[tuple[str, float, float]]:
    """Per bend: change of the whole volume and of the segment's, per cent."""
    template = model.shaped(betas)
    rows = []
    for name, turns, parts in BENDS:
        bent = posed(model, template, pose_of(turns))
        changes = []
        for chosen in ((), parts):
            segment = segment_of(model, chosen)
            changes.append(100 * (segment.volume_m3(bent) / segment.volume_m3(template) - 1))
        rows.append((name, changes[0], changes[1]))
    return rows


def filled_space(model: BodyModel, betas: np.ndarray) -> list[float]:
    """Per deep bend: change of the space that the whole body fills, per cent."""
    template = model.shaped(betas)
    before = union_volume_m3(template, model.faces)
    turns_of = {name: turns for name, turns, _ in BENDS}
    bent = [posed(model, template, pose_of(turns_of[name])) for name in DEEP_BENDS]
    return [100 * (union_volume_m3(v, model.faces) / before - 1) for v in bent]


def print_volume_table() -> None:
    columns, filled = [], []
    for sex in ("neutral", "female", "male"):
        model = load_body(f"free:{sex}", show_progress=False)
        heavy = weight_component(model)
        for step in (0, 2, -2):
            betas = np.zeros(model.n_betas)
            betas[heavy] = step
            columns.append((f"{sex} {step:+d}" if step else sex, kept_volume(model, betas)))
            filled.append(filled_space(model, betas))
    print("Change of volume, %: whole body / segment around the joint\n")
    print("| bend | " + " | ".join(name for name, _ in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for i, (bend, *_) in enumerate(BENDS):
        print(
            f"| {bend} | "
            + " | ".join(f"{rows[i][1]:+.1f} / {rows[i][2]:+.1f}" for _, rows in columns)
            + " |"
        )
    worst = [max(columns, key=lambda c: max(abs(r[k]) for r in c[1])) for k in (1, 2)]
    for k, what in ((1, "whole"), (2, "segment")):
        row = max(worst[k - 1][1], key=lambda r: abs(r[k]))
        print(f"\nLargest change of the {what}: {row[k]:+.2f} % ({worst[k - 1][0]}, {row[0]})")
    print("\nChange of the space filled (overlaps counted once), %\n")
    print("| bend | " + " | ".join(name for name, _ in columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for i, bend in enumerate(DEEP_BENDS):
        print(f"| {bend} | " + " | ".join(f"{changes[i]:+.1f}" for changes in filled) + " |")


def least_ms(call: Callable[[], object], repetitions: int) -> float:
    """Least wall time of a call in milliseconds, after one that compiles."""
    import jax

    jax.block_until_ready(call())
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times)


def print_speed_table(repetitions: int) -> None:
    """Ours and theirs on the free body written to SMPL's keys, in one process and double precision."""
    from fit.body.skinning import SkinningArrays, joints_from_betas, shape_template, skin, skin_with_jacobian

    model = load_body("free:neutral", show_progress=False)
    arrays = SkinningArrays.of(model)
    import jax
    import jax.numpy as jnp

    rng = np.random.default_rng(0)
    pose = jnp.asarray(rng.normal(0, 0.3, (model.n_joints, 3)))
    betas = jnp.asarray(rng.normal(0, 0.5, model.n_betas))
    translation = jnp.asarray([0.1, 0.2, 0.3])

    @jax.jit
    def forward(pose: jax.Array, translation: jax.Array, betas: jax.Array) -> jax.Array:
        template, joints = shape_template(arrays, betas), joints_from_betas(arrays, betas)
        return skin(arrays, template, joints, pose, translation)

    @jax.jit
    def jacobian(pose: jax.Array, translation: jax.Array, betas: jax.Array) -> jax.Array:
        template, joints = shape_template(arrays, betas), joints_from_betas(arrays, betas)
        _, turn, columns = skin_with_jacobian(arrays, template, joints, pose, translation)
        return columns.at[:, :, -len(betas) :].add(turn @ arrays.shape_directions)

    def ours(call: Callable[..., object]) -> float:
        return least_ms(lambda: call(pose, translation, betas), repetitions)

    rows = [("forward", ours(forward)), ("Jacobian", ours(jacobian))]
    vertices = np.asarray(forward(pose, translation, betas))
    theirs = _their_times(model, pose, translation, betas, repetitions, vertices)
    print(
        f"\n{model.n_vertices} vertices, {model.n_joints} joints, {model.n_betas} betas, "
        f"least of {repetitions} calls"
    )
    print("\n| double precision, jit | bodyhull ms | body-models ms | ratio |\n|---|---|---|---|")
    for (name, ms), their_ms in zip(rows, theirs or (None, None), strict=True):
        other = "not installed | -" if their_ms is None else f"{their_ms:.2f} | {ms / their_ms:.2f}"
        print(f"| {name} | {ms:.2f} | {other} |")


def _their_times(
    model: BodyModel,
    pose: np.ndarray,
    translation: np.ndarray,
    betas: np.ndarray,
    repetitions: int,
    expected: np.ndarray,
) -> tuple[float, float] | None:
    """Forward and Jacobian (jacfwd, same parameters) of body-models; None where it is not installed."""
    try:
        from body_models.smpl.jax import SMPL
    except ImportError:
        return None
    import jax
    import jax.numpy as jnp

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "free.npz"
        model.save(path)
        theirs = SMPL(model_path=path)
    # It loads single precision; the same numbers in double, so that both do the same work.
    theirs._assets = jax.tree_util.tree_map(
        lambda a: a.astype(jnp.float64) if getattr(a, "dtype", None) == jnp.float32 else a, theirs._assets
    )

    def forward(pose: jax.Array, translation: jax.Array, betas: jax.Array) -> jax.Array:
        return theirs.forward_vertices(
            pose[1:], pelvis_rotation=pose[0], shape=betas, global_translation=translation
        )

    jitted = jax.jit(forward)
    jacobian = jax.jit(jax.jacfwd(forward, argnums=(0, 1, 2)))
    found = jitted(pose, translation, betas)
    assert found.dtype == np.float64, f"their vertices came as {found.dtype}"
    assert np.abs(np.asarray(found) - expected).max() < 1e-5, "both pose the same body"
    return (
        least_ms(lambda: jitted(pose, translation, betas), repetitions),
        least_ms(lambda: jacobian(pose, translation, betas), repetitions),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--volume", action="store_true", help="only the volume table")
    parser.add_argument("--speed", action="store_true", help="only the speed table")
    parser.add_argument("--repetitions", type=int, default=40)
    options = parser.parse_args()
    if not options.speed:
        print_volume_table()
    if not options.volume:
        print_speed_table(options.repetitions)


if __name__ == "__main__":
    main()
