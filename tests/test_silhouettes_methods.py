"""Silhouettes from pictures: every method against the truth, shadows, light, screens, several people."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from capture.chroma_key import find_key, key_of_colour
from capture.errors import RecordingError
from capture.filmed import open_filmed
from capture.layouts import ring_layout
from capture.mask_border import refined
from capture.plate_difference import PlateDifference
from capture.plates import find_empty_scenes, learn_plate, median_plate
from capture.rig import Rig
from capture.silhouette_maker import MakerOptions, SilhouetteMaker, prepare_maker
from tests.silhouette_scenes import GREEN, Scene, balls, iou, write_scene

RIG = ring_layout(6, (180, 240), camera_height_m=1.5)
N_FRAMES = 8


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    root = tmp_path_factory.mktemp("scenes")
    made: dict[str, Scene] = {}

    def scene(kind: str) -> Scene:
        if kind not in made:
            source = balls(N_FRAMES, passer_by=kind == "passer-by")
            made[kind] = write_scene(root / kind, RIG, source, kind, n_frames=N_FRAMES, seed=5)
        return made[kind]

    return scene


def scores(maker: SilhouetteMaker, scene: Scene, frames=(0, 3, 7)) -> np.ndarray:
    found = []
    for frame in frames:
        made = maker.make(frame, maker.read(frame))
        assert made.problems == ()
        for camera_idx, mask in enumerate(made.masks):
            assert mask is not None and set(np.unique(mask)) <= {0, 128, 255}
            found.append(iou(mask, scene.truth[camera_idx, frame]))
    return np.array(found)


@pytest.mark.parametrize(
    ("kind", "method", "typical", "worst"),
    [
        ("studio", "plate", 0.93, 0.88),
        ("studio", "mog2", 0.93, 0.88),
        ("studio", "knn", 0.93, 0.88),
        ("studio", "gsoc", 0.9, 0.8),
        ("studio", "cnt", 0.9, 0.8),
        ("room", "auto", 0.93, 0.85),
        ("shadow", "plate", 0.93, 0.85),
        ("shadow", "auto", 0.93, 0.85),
        ("shadow", "mog2", 0.93, 0.85),
        ("drift", "plate", 0.93, 0.85),
        ("drift", "mog2", 0.93, 0.85),
        ("drift", "auto", 0.93, 0.85),
        ("green", "chroma", 0.93, 0.85),
    ],
)
def test_each_method_finds_the_person(scenes, kind, method, typical, worst):
    scene = scenes(kind)
    maker = prepare_maker(open_filmed(scene.root), MakerOptions(method, repair=False))
    found = scores(maker, scene)
    assert np.median(found) > typical, f"median {np.median(found):.3f}"
    assert found.min() > worst, f"worst {found.min():.3f}"


def test_a_screen_is_noticed_and_its_light_on_legs_makes_no_holes(scenes):
    scene = scenes("green")
    maker = prepare_maker(open_filmed(scene.root), MakerOptions(repair=False))
    assert set(maker.methods) == {"chroma"}
    for camera_idx, mask in enumerate(maker.make(3, maker.read(3)).masks):
        inside = cv2.erode(scene.truth[camera_idx, 3], np.ones((5, 5), np.uint8)) > 0
        assert mask is not None and (mask[inside] == 255).mean() > 0.995
    key = key_of_colour(*GREEN.tolist())
    found = find_key(maker.backgrounds[0])
    assert key is not None and found is not None and found[1] > 0.9
    assert np.linalg.norm(found[0] - key) < 0.1 * np.linalg.norm(key)
    assert find_key(np.full((64, 64, 3), 120, np.uint8)) is None and key_of_colour(90, 92, 90) is None


def test_only_the_subject_when_somebody_else_is_in_view(scenes):
    scene = scenes("passer-by")
    filmed = open_filmed(scene.root)
    plain = prepare_maker(filmed, MakerOptions("plate", repair=False))
    assert plain.subject is not None
    found = scores(plain, scene)
    assert np.median(found) > 0.9, f"median {np.median(found):.3f}"
    everyone = scores(replace(plain, subject=None), scene)
    assert found.mean() > everyone.mean() + 0.05, "the choice matters in this scene"
    # In a view where the two overlap only the other cameras can tell them apart.
    mended = scores(prepare_maker(filmed, MakerOptions("plate")), scene)
    assert mended.min() >= found.min() and mended.mean() >= found.mean() - 0.002


def test_frames_give_the_same_in_any_order(scenes):
    filmed = open_filmed(scenes("studio").root)
    for method in ("plate", "mog2", "knn", "gsoc", "cnt"):
        maker = prepare_maker(filmed, MakerOptions(method, repair=False))
        first = maker.make(2, maker.read(2)).masks
        for frame in (7, 7, 7, 7, 7, 0):
            maker.make(frame, maker.read(frame))
        again = maker.make(2, maker.read(2)).masks
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True)), method


def test_light_that_is_switched_is_told_and_the_other_cameras_go_on(scenes):
    filmed = open_filmed(scenes("studio").root)
    for method in ("plate", "auto", "mog2"):
        maker = prepare_maker(filmed, MakerOptions(method, repair=False))
        pictures = maker.read(3)
        lit = pictures[1][0]
        assert lit is not None
        half = lit.copy()
        half[:, : lit.shape[1] * 2 // 3] = 255 - half[:, : lit.shape[1] * 2 // 3]
        half[:, lit.shape[1] * 2 // 3 :] //= 3
        pictures[1] = (half, "")
        made = maker.make(3, pictures)
        assert [mask is None for mask in made.masks] == [False, True, False, False, False, False], method
        assert len(made.problems) == 1
        assert made.problems[0].startswith("Camera cam-001, frame 000003: ")
        assert "% of the picture differs from the background (did the light change" in made.problems[0]


def test_nobody_in_view_is_an_empty_silhouette_not_noise(scenes):
    scene = scenes("studio")
    maker = prepare_maker(open_filmed(scene.root), MakerOptions("plate", repair=False))
    empty = [(picture, "") for picture in maker.backgrounds]
    made = maker.make(0, empty)
    assert made.masks == (None,) * 6 and len(made.problems) == 6
    assert "silhouette is empty (nothing differs from the background where cameras agree)" in made.problems[0]


def test_without_calibration_each_camera_is_worked_on_by_itself(scenes, tmp_path):
    scene = scenes("studio")
    for folder in ("Pictures", "background"):
        (tmp_path / folder).symlink_to(scene.root / folder)
    filmed = open_filmed(tmp_path)
    assert filmed.rig is None
    assert any(note.startswith("No calibration: each camera is worked on by itself") for note in filmed.notes)
    maker = prepare_maker(filmed, MakerOptions("auto"))
    assert maker.subject is None and maker.repair is None
    assert np.median(scores(maker, scene)) > 0.93


def test_the_median_over_time_stands_in_for_a_plate(tmp_path):
    """A person who walks far enough to uncover what is behind; cameras that look along the path see none."""
    rig = Rig(tuple(RIG[idx] for idx in (1, 2, 4, 5)))

    def far(camera, frame):
        return balls(17)(camera, 0 if frame < 8 else 16)

    scene = write_scene(tmp_path / "r", rig, far, "room", n_frames=17, n_empty=0, seed=8)
    filmed = open_filmed(scene.root)
    assert filmed.scenes == {}
    maker = prepare_maker(filmed, MakerOptions("median", repair=False))
    # 8 frames here, 9 there: where the person stands longer counts as background, elsewhere it is seen.
    found = [iou(mask, scene.truth[idx, 0]) for idx, mask in enumerate(maker.make(0, maker.read(0)).masks)]
    assert np.median(found) > 0.6, found
    with pytest.raises(
        RecordingError, match=r"--method plate: no background plate for cam-000, .* --method median"
    ):
        prepare_maker(filmed, MakerOptions("plate"))
    with pytest.raises(RecordingError, match=r"camera cam-000 shows no screen of one colour; .* --key R,G,B"):
        prepare_maker(filmed, MakerOptions("chroma"))


def test_a_plate_learns_mean_and_spread():
    rng = np.random.default_rng(4)
    sigma = np.where(np.arange(40)[None, :, None] < 20, 2.0, 8.0)
    frames = [
        np.clip(np.rint(120 + sigma * rng.standard_normal((30, 40, 3))), 0, 255).astype(np.uint8)
        for _ in range(60)
    ]
    plate = learn_plate(iter(frames))
    assert plate.n_frames == 60 and np.abs(plate.mean.astype(int) - 120).max() <= 5
    assert plate.spread is not None
    assert plate.spread[:, :20].mean() == pytest.approx(2.0, rel=0.1)
    assert plate.spread[:, 20:].mean() == pytest.approx(8.0, rel=0.1)
    # The quiet half notices a change that is noise in the other.
    changed = np.full((30, 40, 3), 138, np.uint8)
    differs = PlateDifference.of_plate(plate, shadows=False)
    seen = 255 - cv2.inRange(changed, differs.low, differs.high)
    assert (seen[:, :20] > 0).mean() > 0.95 and (seen[:, 20:] > 0).mean() < 0.05
    assert learn_plate(iter(frames[:1])).spread is None
    stack = np.stack([*frames[:20], *[np.full((30, 40, 3), 240, np.uint8)] * 9])
    steady = median_plate(stack, np.median(stack, axis=0).astype(np.uint8))
    assert np.abs(steady.mean.astype(int) - 120).mean() < 6


def test_a_shadow_is_told_from_grey_clothes():
    """Both are the wall's colour, dimmed; one lies on the background, the other in the person."""
    wall = np.full((200, 160, 3), 180, np.uint8)
    plate = learn_plate(iter([wall, wall]))
    picture = wall.copy()
    picture[30:60, 60:100] = (200, 140, 120)
    picture[60:110, 60:100] = 126
    picture[110:160, 60:100] = (30, 30, 60)
    picture[160:175, 90:150] = 120
    look = PlateDifference.of_plate(plate).look(picture)
    fine = look.fine((slice(0, 200), slice(0, 160)))
    assert (fine[32:158, 62:98] == 255).mean() > 0.98, "head, grey shirt, trousers"
    assert (fine[164:172, 104:146] == 255).mean() < 0.02, "shadow on the floor"


@pytest.mark.parametrize("how", ["guided", "grabcut"])
def test_the_border_is_moved_to_the_edge(how):
    yy, xx = np.mgrid[:200, :160]
    truth = np.where(((yy - 100) / 70) ** 2 + ((xx - 80) / 40) ** 2 < 1, 255, 0).astype(np.uint8)
    noise = np.random.default_rng(1).normal(0, 4, (200, 160, 3))
    picture = np.clip(np.where(truth[..., None] > 0, (190, 120, 90), (60, 90, 110)) + noise, 0, 255)
    picture = picture.astype(np.uint8)
    rough = cv2.dilate(truth, np.ones((3, 3), np.uint8)) if how == "guided" else np.roll(truth, 2, axis=1)
    better = refined(rough, picture, how)
    assert iou(better, truth) > iou(rough, truth) + 0.02
    assert np.array_equal(refined(rough, picture, "none"), rough)
    nothing = np.zeros_like(truth)
    assert np.array_equal(refined(nothing, picture, how), nothing)


def test_empty_scenes_are_found_by_name_and_number(tmp_path):
    sizes = {"cam-000": (8, 6), "cam-001": (8, 6), "cam-002": (8, 6)}
    with pytest.raises(RecordingError, match="no such folder of background plates"):
        find_empty_scenes(tmp_path / "none", sizes)
    with pytest.raises(RecordingError, match=r"no background plate here; expected <camera>\.png"):
        find_empty_scenes(tmp_path, sizes)
    small = np.zeros((6, 8, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "cam00.png"), small)
    (tmp_path / "cam-001").mkdir()
    for idx in range(3):
        cv2.imwrite(str(tmp_path / "cam-001" / f"{idx}.png"), small if idx else np.zeros((9, 9, 3), np.uint8))
    found = find_empty_scenes(tmp_path, sizes)
    assert list(found) == ["cam-000", "cam-001"]
    assert len(list(found["cam-000"].frames())) == 1
    assert len(list(found["cam-001"].frames())) == 2, "the one of another size is left out"
    cv2.imwrite(str(tmp_path / "cam00.png"), np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(RecordingError, match=r"background plate of 5x5 px, but camera cam-000 films 8x6 px"):
        list(found["cam-000"].frames())
    (tmp_path / "cam00.png").write_bytes(b"x")
    with pytest.raises(RecordingError, match=r"cam00\.png: background plate cannot be decoded"):
        list(found["cam-000"].frames())
