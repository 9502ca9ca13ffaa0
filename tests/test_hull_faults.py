"""One camera with a wrong silhouette: it is named, and the hull stays what the other cameras make of it."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from hull.errors import HullError
from hull.faults import WRONG_HULL, CameraFault, FaultAction, FaultKind
from hull.visual_hull import Hull, HullOptions, build_hull
from tests.hull_subjects import Balls, figure

Image = np.ndarray
PLAIN = HullOptions(find_faults=False)


def _extent(image: Image) -> tuple[int, int]:
    """First row of the person, and how many rows there are."""
    rows = np.flatnonzero(image.any(axis=1))
    return int(rows[0]), len(rows)


def without_a_leg(image: Image) -> Image:
    top, n = _extent(image)
    start = top + int(0.6 * n)
    columns = np.flatnonzero(image[start:].any(axis=0))
    image[start:, : int(np.median(columns))] = 0
    return image


def without_the_lower_part(image: Image) -> Image:
    top, n = _extent(image)
    image[top + int(0.7 * n) :] = 0
    return image


def with_a_hole(image: Image) -> Image:
    top, n = _extent(image)
    row = top + int(0.3 * n)
    centre = (int(np.flatnonzero(image[row]).mean()), row)
    return cv2.circle(image, centre, max(int(0.035 * n), 6), 0, -1)


def with_a_hole_in_a_thigh(image: Image) -> Image:
    """As wide as the thigh, nearly."""
    top, n = _extent(image)
    row = top + int(0.62 * n)
    columns = np.flatnonzero(image[row])
    run = columns[: int(np.argmax(np.append(np.diff(columns) > 1, True))) + 1]
    return cv2.circle(image, (int(run.mean()), row), int(0.034 * n), 0, -1)


def without_the_head(image: Image) -> Image:
    top, n = _extent(image)
    image[: top + int(0.14 * n)] = 0
    return image


def inverted(image: Image) -> Image:
    return 255 - image


def of_another_frame(image: Image) -> Image:
    """The person turned round and a step aside."""
    return np.roll(image[:, ::-1], image.shape[1] // 12, axis=1)


def shifted(image: Image) -> Image:
    return np.roll(image, 10, axis=1)


def empty(image: Image) -> Image:
    return np.zeros_like(image)


def full(image: Image) -> Image:
    return np.full_like(image, 255)


FAULTS: dict[Callable[[Image], Image], set[FaultKind]] = {
    without_a_leg: {FaultKind.PART_MISSING},
    without_the_lower_part: {FaultKind.PART_MISSING},
    with_a_hole: {FaultKind.PART_MISSING},
    with_a_hole_in_a_thigh: {FaultKind.PART_MISSING},
    without_the_head: {FaultKind.PART_MISSING},
    inverted: {FaultKind.INVERTED},
    of_another_frame: {FaultKind.MOVED, FaultKind.OTHER},
    shifted: {FaultKind.MOVED},
    empty: {FaultKind.EMPTY},
    full: {FaultKind.FULL},
}
CULPRIT = 5


class Case:
    def __init__(self, n_cameras: int, side_px: int, voxel_m: float) -> None:
        self.rig = dome_layout(n_cameras, (side_px, side_px))
        self.images = figure().silhouettes(self.rig)
        self.voxel_m = voxel_m
        self.clean = self.hull({})

    def hull(self, faults: dict[int, Callable[[Image], Image]], **options: bool) -> Hull:
        images = [faults[k](image.copy()) if k in faults else image for k, image in enumerate(self.images)]
        return build_hull(self.rig, images, self.voxel_m, options=HullOptions(**options))

    def change(self, hull: Hull) -> float:
        return hull.volume_m3 / self.clean.volume_m3 - 1


@pytest.fixture(scope="module")
def sixteen() -> Case:
    return Case(16, 512, 0.016)


@pytest.fixture(scope="module")
def sixty_eight() -> Case:
    return Case(68, 400, 0.02)


def test_nothing_is_found_where_nothing_is_wrong(sixteen: Case, sixty_eight: Case) -> None:
    """And the hull is the same to the last bit as without looking."""
    for case in (sixteen, sixty_eight):
        assert case.clean.faults == ()
        assert case.clean.problems == ()
        assert np.array_equal(case.clean.vertices, case.hull({}, find_faults=False).vertices)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.__name__)
@pytest.mark.parametrize("n_cameras", [16, 68])
def test_the_camera_is_named_and_the_volume_stays(
    fault: Callable[[Image], Image], n_cameras: int, request: pytest.FixtureRequest
) -> None:
    case: Case = request.getfixturevalue("sixteen" if n_cameras == 16 else "sixty_eight")
    hull = case.hull({CULPRIT: fault})
    assert [f.name for f in hull.faults] == [case.rig[CULPRIT].name], hull.problems
    assert hull.faults[0].kind in FAULTS[fault], hull.faults
    assert abs(case.change(hull)) < 0.02, f"volume {case.change(hull):+.2%} of the clean hull's"
    assert hull.problems == (hull.faults[0].sentence(),)
    assert f"camera {case.rig[CULPRIT].name}: " in hull.problems[0]


def test_a_small_rig_keeps_what_the_camera_has_right(sixteen: Case) -> None:
    """Only the region is unknown: nearer to the clean hull than without the camera."""
    hull = sixteen.hull({CULPRIT: without_a_leg})
    assert hull.faults[0].action is FaultAction.REGION_UNKNOWN
    assert 0.08 < hull.faults[0].missing < 0.3
    assert hull.faults[0].surplus < 0.01
    part = Rig(tuple(c for k, c in enumerate(sixteen.rig) if k != CULPRIT))
    images = [image for k, image in enumerate(sixteen.images) if k != CULPRIT]
    dropped = build_hull(part, images, sixteen.voxel_m)
    assert abs(sixteen.change(hull)) < abs(sixteen.change(dropped))


def test_how_far_a_silhouette_is_moved_is_told(sixteen: Case) -> None:
    fault = sixteen.hull({2: shifted}).faults[0]
    assert fault.moved_px == pytest.approx((10.0, 0.0), abs=1.5)
    assert re_found("is moved by about (9|10|11) px to the right", fault)


def test_a_camera_that_shows_too_much_is_told_of_and_kept(sixteen: Case) -> None:
    """It cuts nothing by that; the hull is the same as without it."""

    def with_a_shadow(image: Image) -> Image:
        image[40:160, 40:160] = 255
        return image

    hull = sixteen.hull({7: with_a_shadow})
    assert [f.name for f in hull.faults] == [sixteen.rig[7].name]
    assert (hull.faults[0].kind, hull.faults[0].action) == (FaultKind.TOO_MUCH, FaultAction.KEPT)
    assert hull.faults[0].surplus > 0.1
    assert hull.problems[-1].endswith("of its lines of sight); it cuts nothing by that")
    assert abs(sixteen.change(hull)) < 0.01


@pytest.mark.parametrize("culprit", [0, 3, 8, 11, 15])
@pytest.mark.parametrize("place", [(0.0, 0.0, 1.2), (0.04, 0.0, 1.05)])
def test_a_hole_in_the_trunk_is_found_in_any_camera(
    sixteen: Case, culprit: int, place: tuple[float, float, float]
) -> None:
    """12 cm wide, and no other camera's line of sight says anything against it."""
    camera = sixteen.rig[culprit]
    pixels, depth = camera.project(np.array([place]))
    centre = (round(float(pixels[0, 0])), round(float(pixels[0, 1])))
    radius = round(0.06 * camera.intrinsics[0, 0] / float(depth[0]))
    hull = sixteen.hull({culprit: lambda image: cv2.circle(image, centre, radius, 0, -1)})
    assert [f.camera_idx for f in hull.faults] == [culprit], hull.problems
    assert abs(sixteen.change(hull)) < 0.015


def test_eight_cameras_find_a_hole_in_the_trunk() -> None:
    rig = dome_layout(8, (512, 512))
    images = figure().silhouettes(rig)
    clean = build_hull(rig, images, 0.016)
    assert clean.faults == ()
    images[2] = with_a_hole(images[2])
    hull = build_hull(rig, images, 0.016)
    assert [f.camera_idx for f in hull.faults] == [2]
    assert abs(hull.volume_m3 / clean.volume_m3 - 1) < 0.03


def test_several_cameras_may_be_wrong_at_once(sixteen: Case) -> None:
    wrong = {1: without_the_lower_part, 6: inverted, 11: shifted, 14: empty}
    hull = sixteen.hull(wrong)
    assert [f.camera_idx for f in hull.faults] == sorted(wrong), hull.problems
    assert abs(sixteen.change(hull)) < 0.04
    lost = sixteen.hull({4: without_a_leg, 9: without_a_leg})
    assert [f.camera_idx for f in lost.faults] == [4, 9]


def test_no_more_than_a_quarter_is_left_out(sixteen: Case) -> None:
    """With five wrong of sixteen the hull is what is left, or none; each is named, whatever happens."""
    wrong = dict.fromkeys((0, 3, 6, 9, 12), without_the_lower_part)
    hull = sixteen.hull(wrong)
    out = [f for f in hull.faults if f.action is not FaultAction.KEPT]
    assert len(out) <= 4
    assert {f.camera_idx for f in hull.faults} <= set(wrong)
    assert len(hull.faults) >= 4


def test_few_cameras_are_told_of_and_kept() -> None:
    rig = ring_layout(4, (320, 320))
    images = figure().silhouettes(rig)
    assert build_hull(rig, images, 0.02).faults == ()
    images[2] = without_the_lower_part(images[2])
    hull = build_hull(rig, images, 0.016)
    assert [f.name for f in hull.faults] == [rig[2].name]
    assert hull.faults[0].action is FaultAction.KEPT
    assert hull.problems[-1].endswith("too few cameras are left to do without it")
    plain = build_hull(rig, images, 0.016, options=PLAIN)
    assert np.array_equal(hull.vertices, plain.vertices)


@pytest.mark.parametrize("fault", [without_the_lower_part, inverted, of_another_frame, empty])
@pytest.mark.parametrize("culprit", range(4))
def test_of_four_cameras_none_is_silent(fault: Callable[[Image], Image], culprit: int) -> None:
    """The hull may lose much; that it does is said, and the culprit is among those named."""
    rig = dome_layout(4, (320, 320))
    images = figure().silhouettes(rig)
    images[culprit] = fault(images[culprit])
    hull = build_hull(rig, images, 0.02)
    assert culprit in {f.camera_idx for f in hull.faults}, hull.problems
    if fault is empty:
        assert hull.faults[0].action is FaultAction.LEFT_OUT, "three others see somebody"
        assert hull.volume_m3 > 0.06
        return
    assert hull.contradiction > WRONG_HULL
    (mark,) = [m for m in hull.marks if m.startswith("the silhouettes contradict one another: ")]
    assert f"camera {rig[culprit].name}" in mark.split("look at")[1]


def test_three_cameras_are_too_few_to_tell_whose() -> None:
    rig = ring_layout(3, (320, 320))
    images = figure().silhouettes(rig)
    assert build_hull(rig, images, 0.02).marks == ()
    images[1] = without_the_lower_part(images[1])
    hull = build_hull(rig, images, 0.02)
    assert hull.faults == ()
    assert hull.marks[0].endswith("; 3 are too few to tell whose is wrong")


def test_half_of_the_cameras_from_another_frame(sixteen: Case) -> None:
    """Nobody can say which half is right; that they disagree is said."""
    assert sixteen.clean.contradiction == 0.0
    there = Balls(figure().centres + np.array([0.06, 0.0, 0.0]), figure().radii).silhouettes(sixteen.rig)
    images = [
        image if k % 2 else other for k, (image, other) in enumerate(zip(sixteen.images, there, strict=True))
    ]
    hull = build_hull(sixteen.rig, images, sixteen.voxel_m)
    assert hull.contradiction > WRONG_HULL
    assert hull.marks[0].startswith("the silhouettes contradict one another: ")
    assert hull.marks[0] in hull.problems


def test_more_than_a_quarter_moved_is_marked_and_named(sixteen: Case) -> None:
    wrong = dict.fromkeys((0, 3, 6, 9, 12), shifted)
    hull = sixteen.hull(wrong)
    assert {f.camera_idx for f in hull.faults} == set(wrong)
    assert hull.contradiction > WRONG_HULL
    assert all(sixteen.rig[k].name in hull.marks[0] for k in wrong)


@pytest.mark.parametrize("n_wrong", [5, 16])
def test_inverted_silhouettes_are_refused(sixteen: Case, n_wrong: int) -> None:
    images = [255 - image if k < n_wrong else image for k, image in enumerate(sixteen.images)]
    with pytest.raises(
        HullError, match=f"{n_wrong} of 16 cameras show person all along .* are they inverted"
    ):
        build_hull(sixteen.rig, images, sixteen.voxel_m)


def test_empty_silhouettes_are_refused(sixteen: Case) -> None:
    with pytest.raises(HullError, match="0 of 16 silhouettes show anything"):
        build_hull(sixteen.rig, [np.zeros_like(image) for image in sixteen.images], sixteen.voxel_m)


@pytest.mark.parametrize("n_cameras", [16, 68])
def test_ragged_outlines_and_a_pixel_of_calibration_are_no_faults(n_cameras: int) -> None:
    random = np.random.default_rng(n_cameras)
    rig = dome_layout(n_cameras, (384, 384))
    images = []
    for image in figure().silhouettes(rig):
        noise = cv2.resize(random.normal(size=(64, 64)).astype(np.float32), (384, 384))
        depth = cv2.distanceTransform(image, cv2.DIST_L2, 3) - cv2.distanceTransform(
            255 - image, cv2.DIST_L2, 3
        )
        ragged = np.where(depth + 1.5 * noise > 0, 255, 0).astype(np.uint8)
        images.append(np.roll(ragged, random.integers(-1, 2, size=2), axis=(0, 1)))
    assert build_hull(rig, images, 0.02).faults == ()


def test_specks_are_no_faults(sixteen: Case) -> None:
    random = np.random.default_rng(1)
    images = []
    for image in sixteen.images:
        flipped = random.random(image.shape) < 0.001
        images.append(np.where(flipped, 255 - image, image).astype(np.uint8))
    hull = build_hull(sixteen.rig, images, sixteen.voxel_m)
    assert hull.faults == ()


def test_a_true_hole_is_no_fault() -> None:
    """A ring held up has a hole that some cameras see through."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ring = np.column_stack([0.35 * np.cos(angle), np.zeros(60), 1.1 + 0.35 * np.sin(angle)])
    subject = Balls(ring, np.full(60, 0.06))
    rig = dome_layout(16, (400, 400))
    assert build_hull(rig, subject.silhouettes(rig), 0.016).faults == ()


def test_cropped_cameras_are_no_faults() -> None:
    rig = ring_layout(12, (320, 320), camera_height_m=1.4)
    images: list[np.ndarray] = figure().silhouettes(rig)
    for image in images[::2]:
        image[:130] = 128
    images[3][:, :160] = 128
    assert build_hull(rig, images, 0.02).faults == ()


def test_nothing_left_whatever_is_left_out() -> None:
    rig = dome_layout(8, (200, 200))
    images = [np.zeros((200, 200), np.uint8) if k < 4 else i for k, i in enumerate(figure().silhouettes(rig))]
    with pytest.raises(HullError, match=f"the silhouettes of camera {rig[0].name}, .* show nobody"):
        build_hull(rig, images, 0.02)


def test_a_fault_as_data(sixteen: Case) -> None:
    fault = CameraFault(3, "cam-003", FaultKind.MOVED, FaultAction.LEFT_OUT, 0.12345, 0.1, (9.96, -0.02))
    assert fault.as_dict() == {
        "camera": "cam-003",
        "kind": "moved",
        "action": "left_out",
        "missing": 0.1235,
        "surplus": 0.1,
        "moved_px": [10.0, -0.0],
    }


def re_found(pattern: str, fault: CameraFault) -> bool:
    import re

    return re.search(pattern, fault.sentence()) is not None
