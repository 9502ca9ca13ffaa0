"""The Momentum Human Rig becomes a body of SMPL's structure: on a made rig with its names and controls.

The rig's own assets cannot be here. Where `body-models` is installed it reads the made rig from MHR's files.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fit.body import BodyModel, BodyModelError
from fit.body.body_file import BodyFile, read_body_file
from fit.body.foreign_shapes import DrawnPeople, body_of_people, fold_by_name
from fit.body.mhr import JOINT_OF_BONE, STATURE, Pose, people_of_rig, t_pose
from fit.body.skeleton import JOINT, JOINT_NAMES, MIRROR
from tests.command_line import call
from tests.made_rig import BONE, CARRY, NAMES, PARENTS, MadeRig

N_PEOPLE, N_BETAS = 50, 30
ELBOW = np.degrees(CARRY)


@pytest.fixture(scope="module")
def rig() -> MadeRig:
    return MadeRig()


@pytest.fixture(scope="module")
def turned(rig: MadeRig) -> Pose:
    return t_pose(rig)


@pytest.fixture(scope="module")
def people(rig: MadeRig) -> DrawnPeople:
    return people_of_rig(rig, n_people=N_PEOPLE, show_progress=False)


@pytest.fixture(scope="module")
def file(people: DrawnPeople) -> BodyFile:
    return body_of_people(people, N_BETAS)


def directions(joints: np.ndarray, side: str, bones: list[tuple[str, str]]) -> np.ndarray:
    ends = np.array([[JOINT[f"{side}_{a}"], JOINT[f"{side}_{b}"]] for a, b in bones])
    along = joints[..., ends[:, 1], :] - joints[..., ends[:, 0], :]
    return along / np.linalg.norm(along, axis=-1, keepdims=True)


@pytest.mark.parametrize(("side", "out"), [("left", 1.0), ("right", -1.0)])
def test_everyone_stands_in_smpls_t_pose(people: DrawnPeople, side: str, out: float) -> None:
    arms = directions(people.joints, side, [("shoulder", "elbow"), ("elbow", "wrist"), ("wrist", "hand")])
    legs = directions(people.joints, side, [("hip", "knee"), ("knee", "ankle")])
    off = np.degrees(np.arccos(np.concatenate([out * arms[..., 0], -legs[..., 1]], axis=1)))
    assert off.max() < ELBOW, f"{off.max():.2f} degrees"
    chest, head = people.joints[:, JOINT["spine3"]], people.joints[:, JOINT["head"]]
    assert (head[:, 1] > chest[:, 1]).all()
    toes = directions(people.joints, side, [("ankle", "foot")])[:, 0]
    assert (toes[:, 2] > 0.8).all(), "the feet point to the front (+z)"


def test_palms_look_down_and_both_sides_are_alike(rig: MadeRig, turned: Pose) -> None:
    vertices = rig.forward_vertices(**turned)
    carried = rig.skin_weights
    for side in "lr":
        little, index = (
            vertices[carried[:, BONE[f"{side}_{finger}1"]] == 1].mean(0) for finger in ("pinky", "index")
        )
        across = (index - little) / np.linalg.norm(index - little)
        assert across[2] > 0.98, "the thumb's side is in front"
    at = [next(BONE[bone] for bone, own in JOINT_OF_BONE.items() if own == name) for name in JOINT_NAMES]
    joints = rig.forward_skeleton(**turned)[at, :3, 3]
    np.testing.assert_allclose(joints[MIRROR] * [-1, 1, 1], joints, atol=1e-4)


def test_a_bone_moves_from_rest_as_one_piece(rig: MadeRig, turned: Pose) -> None:
    rest = rig.forward_vertices(**rig.get_rest_pose())
    moved = rig.forward_vertices(**turned)
    for bone in ("l_lowarm", "r_lowleg", "c_head"):
        own = rig.skin_weights[:, BONE[bone]] == 1
        before, after = rest[own] - rest[own].mean(0), moved[own] - moved[own].mean(0)
        np.testing.assert_allclose(before @ before.T, after @ after.T, atol=1e-9)


def test_statures_are_those_of_adults(people: DrawnPeople) -> None:
    tall = np.ptp(people.vertices[:, :, 1], axis=1)
    mean, spread = tall.mean(), tall.std(ddof=1)
    assert abs(mean - STATURE[0]) < 3 * STATURE[1] / np.sqrt(N_PEOPLE), f"mean {mean:.3f} m"
    assert 0.75 * STATURE[1] < spread < 1.3 * STATURE[1], f"SD {spread:.3f} m"
    # Bones are as long as the person is tall, not the same in everybody.
    arms = np.linalg.norm(
        people.joints[:, JOINT["left_wrist"]] - people.joints[:, JOINT["left_elbow"]], axis=1
    )
    assert np.corrcoef(arms, tall)[0, 1] > 0.7


def test_weights_are_those_of_the_named_bones(rig: MadeRig, people: DrawnPeople) -> None:
    np.testing.assert_allclose(people.weights.sum(1), 1, atol=1e-12)
    wanted = {
        "l_uparm": "left_shoulder", "l_uparm_twist3_proc": "left_shoulder", "r_wrist_twist": "right_elbow",
        "r_pinky0": "right_wrist", "r_pinky2": "right_hand", "l_thumb2": "left_wrist", "l_ball": "left_foot",
        "l_subtalar": "left_ankle", "c_spine0": "pelvis", "c_spine3": "spine3", "c_neck_twist1_proc": "neck",
        "c_jaw": "head", "body_world": "pelvis",
    }  # fmt: skip
    folded = fold_by_name(NAMES, PARENTS, JOINT_OF_BONE)
    assert {bone: JOINT_NAMES[folded[BONE[bone]]] for bone in wanted} == wanted
    whole = rig.skin_weights[:, [BONE["l_uparm"], BONE["l_uparm_twist2_proc"]]].sum(1) == 1
    assert whole.any() and (people.weights[whole, JOINT["left_shoulder"]] == 1).all()
    assert set(JOINT_OF_BONE.values()) == set(JOINT) and set(JOINT_OF_BONE) <= set(NAMES)


def test_the_file_holds_them(people: DrawnPeople, file: BodyFile, tmp_path: Path) -> None:
    file.save(tmp_path / "mhr.npz")
    model = BodyModel.of_file(read_body_file(tmp_path / "mhr.npz"))
    spread = (people.vertices - model.template).reshape(N_PEOPLE, -1).T
    betas = np.linalg.lstsq(model.shape_directions.reshape(len(spread), -1), spread, rcond=None)[0]
    shaped = np.stack([model.shaped(b) for b in betas.T])
    rms_mm = 1e3 * float(np.sqrt(((shaped - people.vertices) ** 2).sum(2).mean()))
    assert rms_mm < 3.0, f"{rms_mm:.2f} mm lost"
    joints = np.einsum("jv,nva->nja", file.joint_regressor, people.vertices)
    off_mm = 1e3 * np.linalg.norm(joints - people.joints, axis=2)
    assert off_mm.mean() < 1.5, f"joints {off_mm.mean():.2f} mm"
    assert not model.pose_directions.any() and "Apache-2.0" in model.licence
    assert (file.kind, file.gender, file.shape_directions.shape[2]) == ("SMPL", "neutral", N_BETAS)


class Sideways(MadeRig):
    def forward_skeleton(self, **pose: Any) -> np.ndarray:
        return np.array(
            [[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
        ) @ super().forward_skeleton(**pose)


class Stiff(MadeRig):
    def forward_skeleton(self, **pose: Any) -> np.ndarray:
        return super().forward_skeleton(**self.get_rest_pose())


class Renamed(MadeRig):
    @property
    def joint_names(self) -> list[str]:
        return [name.replace("uparm", "arm") for name in NAMES]


class Ageless(MadeRig):
    """Its limbs turn, its bones stay as long as they are."""

    def forward_skeleton(self, **pose: Any) -> np.ndarray:
        body = np.array(pose["body_pose"])
        body[79:] = 0
        return super().forward_skeleton(**{**pose, "body_pose": body})


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (MadeRig(unit=1.0), r"mhr: its rig has a height of 17\d\.\d\d m; this reads MHR's release 1\.0"),
        (Sideways(), r"mhr: its rig has other axes than y up and z to the front"),
        (Renamed(), r"mhr: its rig has no bones l_uparm, r_uparm \(of 127\)"),
        (Stiff(), r"mhr: its (left|right) \w+ cannot be turned into the T-pose \(4\d degrees off\)"),
        (Ageless(), r"mhr: \w+ to \w+ cannot be made \d+ cm long \([+-]\d+\.\d cm off\)"),
    ],
    ids=["centimetres", "axes", "names", "limbs", "lengths"],
)
def test_another_rig_is_refused(other: MadeRig, said: str) -> None:
    with pytest.raises(BodyModelError, match=said):
        people_of_rig(other, n_people=10, show_progress=False)


def test_without_its_package_or_assets_it_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = call(capsys, "body", "convert", f"mhr:{tmp_path}", tmp_path / "out.npz")
    assert said.code != 0 and not (tmp_path / "out.npz").exists()
    assert "mhr: needs the package body-models" in said.err or (
        "mhr: its assets cannot be had" in said.err
        and "mhr_model.pt" in said.err
        and "mhr:FOLDER" in said.err
    )
    assert "Traceback" not in said.err


def test_its_own_files_through_body_models(
    rig: MadeRig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("body_models", reason="body-models is not installed: pip install 'bodyhull[bodies]'")
    from body_models.mhr.numpy import MHR

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "assets"
    folder.mkdir()
    rig.write(folder)
    theirs, random = MHR(model_path=folder), np.random.default_rng(0)
    pose = {
        name: (1.0 if name == "shape" else 0.3) * random.standard_normal(np.shape(value)).astype(np.float32)
        for name, value in rig.get_rest_pose().items()
    }
    np.testing.assert_allclose(theirs.forward_vertices(**pose), rig.forward_vertices(**pose), atol=1e-5)
    np.testing.assert_allclose(theirs.forward_skeleton(**pose), rig.forward_skeleton(**pose), atol=1e-5)

    written = tmp_path / "mhr.npz"
    said = call(capsys, "body", "convert", f"mhr:{folder / 'mhr_model.pt'}", written)
    assert said.code == 0 and "SMPL, 24 joints, 30 betas" in said.out
    ours = body_of_people(people_of_rig(rig, show_progress=False), 30)
    with_their_hands = read_body_file(written)
    still = ours.weights[:, [JOINT["left_hand"], JOINT["right_hand"]]].sum(1) == 0  # they bring flat hands
    apart = np.abs(with_their_hands.template - ours.template)[still].max()
    assert apart < 2e-3, f"{1e3 * apart:.3f} mm"
    np.testing.assert_allclose(with_their_hands.weights, ours.weights, atol=1e-6)
    assert "Apache-2.0" in with_their_hands.licence
