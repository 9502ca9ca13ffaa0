"""A synthetic recording can be opened like any other, and its truth is the truth."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.layouts import ring_layout
from capture.recording import open_recording
from fit.body import BodyModel, load_body
from fit.body.skeleton import axis_angle_to_matrix, blend_linearly, world_from_rest
from fit.truth import load_truth
from render.light import bake
from render.motions import make_motion
from render.scene import Light, Renderer, Surface
from render.subject import make_subject
from render.synthetic import SyntheticError, blend, film, perform

PEOPLE = Path(__file__).parent.parent.parent / "shared" / "recordings" / "people"
SIZE = (200, 160)
N_FRAMES = 3


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body("free:neutral", show_progress=False)


@pytest.fixture(scope="module")
def filmed(body: BodyModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("film") / "recording"
    truth = film(
        out,
        body=body,
        n_cameras=3,
        size=SIZE,
        layout="ring",
        n_frames=N_FRAMES,
        motion="walk",
        garment="tshirt-shorts",
        seed=7,
        progress=False,
    )
    assert truth == out / "truth" / "truth.npz"
    return out


def test_the_files_of_the_layout(filmed: Path) -> None:
    found = {str(p.relative_to(filmed)) for p in filmed.rglob("*") if p.is_file()}
    wanted = {f"setup/cam{c:02d}.txt" for c in range(3)} | {"truth/truth.npz"}
    for c in range(3):
        for k in range(N_FRAMES):
            wanted |= {
                f"SilhouettesPictures/cam-{c:03d}/silh_{k:06d}.png",
                f"Pictures/cam-{c:03d}/img_{k:06d}.png",
            }
    assert found == wanted


def test_it_opens_with_the_cameras_that_filmed_it(filmed: Path) -> None:
    recording = open_recording(filmed)
    assert recording.frame_ids == tuple(range(N_FRAMES))
    assert recording.metres_per_unit == 1.0
    assert np.allclose(recording.up, [0, 0, 1], atol=1e-6)
    points = np.random.default_rng(0).uniform([-0.6, -0.6, 0], [0.6, 0.6, 2], (50, 3))
    for ours, theirs in zip(ring_layout(3, SIZE), recording.rig, strict=True):
        assert theirs.size == SIZE
        assert np.abs(ours.project(points)[0] - theirs.project(points)[0]).max() < 1e-9
    for frame_id in recording.frame_ids:
        handed = recording.silhouettes(frame_id)
        assert handed.problems == ()
        assert all(image is not None and set(np.unique(image)) == {0, 255} for image in handed.images)
        assert all(recording.picture(c, frame_id).shape == (SIZE[1], SIZE[0], 3) for c in range(3))


def test_silhouettes_are_the_dressed_person_and_hold_the_naked_one(filmed: Path, body: BodyModel) -> None:
    recording, truth = open_recording(filmed), load_truth(filmed)
    performance = perform(make_subject(body, 7, "tshirt-shorts"), "walk", N_FRAMES, 7)
    renderer = Renderer(*SIZE)
    for frame_id in range(N_FRAMES):
        images = recording.silhouettes(frame_id).images
        for camera, image in zip(recording.rig, images, strict=True):
            mask, _ = renderer.silhouette(performance.surfaces(frame_id), camera)
            assert (mask != (image == 255)).sum() <= 2
            naked = [Surface(truth.frame(frame_id), truth.faces)]
            inside = renderer.silhouette(naked, camera)[0]
            assert (inside & (image == 0)).sum() <= 2, "the true body sticks out of the silhouette"
            assert inside.sum() < (image == 255).sum()


def test_pictures_show_the_person_where_the_silhouette_is(filmed: Path) -> None:
    """Before an even floor and wall: inside the silhouette colours differ from the empty studio."""
    recording = open_recording(filmed)
    for camera_idx in range(3):
        pictures = np.stack([recording.picture(camera_idx, k) for k in range(N_FRAMES)]).astype(int)
        masks = np.stack([recording.silhouettes(k).images[camera_idx] == 255 for k in range(N_FRAMES)])
        never = ~cv2.dilate(masks.any(0).astype(np.uint8), np.ones((5, 5))).astype(bool)
        assert np.ptp(pictures, axis=0)[never].max() == 0, "the studio changes"
        empty = np.median(pictures[:, never], axis=0)
        assert empty.std(0).max() < 40
        # a person: skin, cloth, hair; far more colour than grey
        chroma = np.ptp(pictures, axis=3)
        assert chroma[masks].mean() > 3 * chroma[:, never].mean()


def test_the_truth_file_has_the_shape_of_the_people_s(filmed: Path) -> None:
    if not PEOPLE.exists():
        pytest.skip("the recording `people` is not beside this checkout")
    with (
        np.load(filmed / "truth" / "truth.npz") as ours,
        np.load(PEOPLE / "truth" / "m12_lunge.npz") as theirs,
    ):
        for key in theirs.files:
            assert key in ours.files, f"no {key}"
            assert ours[key].ndim == theirs[key].ndim, key
            assert ours[key].dtype.kind == theirs[key].dtype.kind, key
        assert set(np.unique(ours["region"])) == set(np.unique(theirs["region"]))
        joints, their_joints = (json.loads(str(f["joints"])) for f in (ours, theirs))
        assert set(joints[0]) == set(their_joints[0]) and len(joints) == N_FRAMES
        # both face -y: the left side is at +x, hands hang or reach forward
        for places in (joints[0], their_joints[0]):
            assert places["l_hip"][0] > places["r_hip"][0] and places["head"][2] > places["pelvis"][2] > 0.5


def test_the_truth_s_pose_gives_the_truth_s_vertices(filmed: Path, body: BodyModel) -> None:
    with np.load(filmed / "truth" / "truth.npz") as truth:
        data = {key: truth[key] for key in truth.files}
    assert str(data["body"]) == body.name and str(data["body_hash"]) == body.content_hash
    rest = body.joint_regressor @ data["template"]
    for k in range(N_FRAMES):
        turns = axis_angle_to_matrix(data["pose"][k])
        correctives = body.pose_directions @ (turns[1:] - np.eye(3)).ravel()
        bones = world_from_rest(turns, rest)
        posed, _ = blend_linearly(data["template"] + correctives, body.weights, bones)
        homogeneous = np.column_stack([posed + data["translation"][k], np.ones(len(posed))])
        world = (homogeneous @ data["recording_from_body"].T)[:, :3]
        assert np.abs(world - data["vertices"][k]).max() < 1e-6
    assert json.loads(str(data["settings"]))["seed"] == 7


def test_the_truth_s_joints_are_inside_the_body(filmed: Path) -> None:
    with np.load(filmed / "truth" / "truth.npz") as truth:
        joints, vertices = json.loads(str(truth["joints"])), truth["vertices"]
    for places, skin in zip(joints, vertices, strict=True):
        for name, place in places.items():
            assert np.linalg.norm(skin - place, axis=1).min() < 0.15, name


def test_a_sequence_lies_in_its_own_folder(body: BodyModel, tmp_path: Path) -> None:
    truth = film(
        tmp_path,
        body=body,
        n_cameras=2,
        size=(40, 40),
        n_frames=1,
        sequence="first",
        pictures=False,
        progress=False,
    )
    assert truth == tmp_path / "truth" / "first.npz"
    assert (tmp_path / "first" / "SilhouettesPictures" / "cam-001" / "silh_000000.png").exists()
    assert not (tmp_path / "first" / "Pictures").exists()
    assert open_recording(tmp_path, sequence="first").frame_ids == (0,)


def test_an_old_recording_is_not_written_into(filmed: Path, body: BodyModel, tmp_path: Path) -> None:
    (tmp_path / "setup").mkdir()
    (tmp_path / "setup" / "cam77.txt").write_text("left over")
    (tmp_path / "notes.txt").write_text("mine")
    small = {
        "body": body,
        "n_cameras": 1,
        "size": (32, 32),
        "n_frames": 1,
        "pictures": False,
        "progress": False,
    }
    with pytest.raises(SyntheticError, match=r"holds a recording already \(setup\).*--overwrite"):
        film(tmp_path, **small)
    assert (tmp_path / "setup" / "cam77.txt").exists()
    film(tmp_path, overwrite=True, **small)
    assert [p.name for p in (tmp_path / "setup").iterdir()] == ["cam00.txt"]
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"layout": "sphere"}, "no camera layout is called 'sphere'; there are: dome, ring, cage"),
        ({"n_cameras": 0}, "0 cameras of 1024 x 1024 pixels: at least 1 camera"),
        ({"motion": "dance"}, "no motion is called 'dance'"),
        ({"garment": "toga"}, "no outfit is called 'toga'"),
    ],
)
def test_what_cannot_be_filmed(wrong: dict, says: str, body: BodyModel, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=says):
        film(tmp_path / "out", body=body, progress=False, **wrong)
    assert not (tmp_path / "out").exists(), "something was written before the mistake was found"


def test_blending_is_exact_at_both_ends() -> None:
    rng = np.random.default_rng(0)
    front, behind = rng.integers(0, 256, (2, 6, 8, 3), dtype=np.uint8)
    assert np.array_equal(blend(front, np.full((6, 8), 255, np.uint8), behind), front)
    assert np.array_equal(blend(np.zeros_like(front), np.zeros((6, 8), np.uint8), behind), behind)


def test_baked_light_falls_off_with_the_cosine_and_stops_at_an_obstacle() -> None:
    grey = np.full((4, 3), 100, np.uint8)
    floor = Surface(
        np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]),
        np.array([[0, 1, 2], [1, 3, 2]]),
        grey,
    )

    def shown(lights: list[Light], *others: Surface) -> float:
        return float(bake([floor, *others], lights, ambient=0.0)[0].colours.mean())

    down, slanted = np.array([0.0, 0, -1]), np.array([0.0, -np.sqrt(3) / 2, -0.5])
    straight = shown([Light(down, 1.0)])
    assert straight > 20
    assert shown([Light(slanted, 1.0)]) == pytest.approx(straight / 2, abs=1)
    assert shown([Light(down, 1.0)] * 2) > straight
    assert shown([Light(-down, 1.0)]) == 0
    roof = Surface(floor.vertices * 20 + [-1, -1, 0.5], floor.faces, grey)
    assert shown([Light(down, 1.0)], roof) == 0


def test_the_person_does_not_depend_on_the_motion(body: BodyModel) -> None:
    """What is drawn for the body and for the movement are separate streams of one seed."""
    assert not np.array_equal(make_motion("walk", 4, 0).pose, make_motion("walk", 4, 1).pose)
    one, two = (perform(make_subject(body, 3, "tight"), name, 2, 3).subject for name in ("walk", "squat"))
    assert np.array_equal(one.template, two.template)
