"""`bodyhull check`: planted faults are named with their camera, sound recordings are called sound."""

import itertools
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.preflight import PLANTS, Scene, late_by, told_by, write_scene
from bodyhull.checking import Check, check_recording
from capture.frame_facts import FrameFacts
from capture.layouts import dome_layout
from capture.recording import open_recording
from capture.rig import Rig
from capture.still_pictures import frozen_runs
from hull import moments_verdict
from render.spoil import displaced_rig
from tests.capture_scenes import PERSON, ball_mask
from tests.command_line import call

N_CAMERAS, N_FRAMES = 6, 22


@lru_cache(maxsize=1)
def filmed() -> Scene:
    """A person of balls that walks a curve and swings its arm, seen by six cameras."""
    rig = dome_layout(N_CAMERAS, (150, 180))
    masks: list = [[] for _ in rig]
    for k in range(N_FRAMES):
        phase = 2 * np.pi * k / 40
        balls = PERSON.copy()
        arm = slice(len(PERSON) - 9, None)
        along = np.linalg.norm(balls[arm, :3] - [0.2, 0, 1.4], axis=1)
        way = np.array([np.cos(phase), 0.8 * np.sin(phase), np.sin(2 * phase)])
        balls[arm, :3] = np.array([0.2, 0, 1.4]) + along[:, None] * way / np.linalg.norm(way)
        balls[:11, 1] += 0.15 * np.sin(2 * phase)
        balls[:, :2] += [0.25 * np.sin(phase) + 0.1, 0.02 * k - 0.2]
        for row, camera in zip(masks, rig, strict=True):
            row.append(ball_mask(camera, balls))
    return Scene(rig, masks, "balls", as_json=True)


def checked(folder: Path, scene: Scene) -> Check:
    return check_recording(folder, calibration=write_scene(folder, scene))


# Each in one format; a mirrored world differs between them.
CASES = [(name, k % 2 == 0) for k, name in enumerate(PLANTS) if name != "dead"] + [("mirrored, world", True)]


@pytest.mark.parametrize(("name", "as_json"), CASES)
def test_a_planted_fault_is_named_with_its_camera(tmp_path: Path, name: str, as_json: bool) -> None:
    rng = np.random.default_rng(list(PLANTS).index(name) + 5)
    planted = PLANTS[name](replace(filmed(), as_json=as_json), rng)
    assert planted is not None
    scene, kind, cameras = planted
    check = checked(tmp_path, scene)
    expected = [] if not kind else [(kind, None if cameras is None else frozenset(map(str, cameras)))]
    assert told_by(check) == expected, [finding.sentence() for finding in check.findings]


@pytest.mark.parametrize("way", ["black", "no files", "files of no bytes", "black from the middle on"])
def test_a_dead_camera_is_named(tmp_path: Path, way: str) -> None:
    scene = filmed().copy()
    black = np.zeros_like(scene.masks[2][0])
    for k in range(N_FRAMES // 2 if "middle" in way else 0, N_FRAMES):
        scene.masks[2][k] = {"no files": None, "files of no bytes": np.zeros((0, 0), np.uint8)}.get(
            way, black
        )
    check = checked(tmp_path, scene)
    assert [(f.kind.value, f.cameras) for f in check.findings] == [("dead camera", ("cam-002",))], [
        f.sentence() for f in check.findings
    ]


@pytest.mark.parametrize("first_black", [0, N_FRAMES // 2])
def test_a_camera_that_sees_the_person_at_times_is_dead_if_it_never_shows_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first_black: int
) -> None:
    """In a third of the frames without a silhouette most of the others' hull lies in its picture."""
    scene = filmed().copy()
    for k in range(first_black, N_FRAMES):
        scene.masks[2][k] = np.zeros_like(scene.masks[2][0])
    asked = itertools.count()
    monkeypatch.setattr(moments_verdict, "_would_see", lambda *_: 0.9 if next(asked) % 3 == 0 else 0.1)
    check = checked(tmp_path, scene)
    expected = [("dead camera", ("cam-002",))] if first_black == 0 else []
    assert [(f.kind.value, f.cameras) for f in check.findings] == expected


def test_time_offsets_of_several_cameras_are_exact(tmp_path: Path) -> None:
    check = checked(tmp_path, late_by(filmed(), {1: 4, 4: -3}))
    offsets = [camera.offset_frames for camera in check.cameras]
    assert [None if n is None else round(n) for n in offsets] == [0, 4, 0, 0, -3, 0], offsets
    late = [f for f in check.findings if f.kind.value == "unsynchronised camera"]
    assert [f.numbers["offset_frames"] for f in late] == [4, -3]
    assert (
        "cam-001: it is 4 frames late: its frame t + 4 shows what the others show at t" in late[0].sentence()
    )


def test_who_stands_still_tells_no_time_and_raises_no_alarm(tmp_path: Path) -> None:
    scene = filmed().copy()
    scene.masks = [[row[5]] * N_FRAMES for row in scene.masks]
    check = checked(tmp_path, scene)
    assert [camera.offset_frames for camera in check.cameras] == [None] * N_CAMERAS
    assert check.findings == ()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_rig_that_is_off_as_a_whole_is_not_called_late(tmp_path: Path, seed: int) -> None:
    off = displaced_rig(filmed().rig, (2.0, 3.0), (0.02, 0.04), seed)
    check = checked(tmp_path, replace(filmed(), rig=off))
    assert [(f.kind.value, f.whole_rig) for f in check.findings] == [("calibration off", True)], [
        f.sentence() for f in check.findings
    ]
    assert "bodyhull calibrate refine" in check.findings[0].action


def test_the_command_tells_writes_and_returns_a_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, out = tmp_path / "recording", tmp_path / "out"
    recording.mkdir()
    where = write_scene(recording, filmed())
    said = call(capsys, "check", recording, "--calibration", where, "--out", out)
    assert said.code == 0
    assert "verdict: sound, nothing was found" in said.out
    numbers = json.loads((out / "check.json").read_text())
    assert numbers["sound"] and numbers["findings"] == []
    assert [camera["name"] for camera in numbers["cameras"]] == list(filmed().rig.names)
    first = numbers["cameras"][0]
    assert first["size"] == [150, 180]
    assert 3 < first["distance_m"] < 5 and first["residual_px"] < 2 and first["surplus"] < 0.02
    assert first["cropped"] == 0 and first["shown"] == 1 and first["area_low"] < first["area"]
    assert numbers["rig"]["unit"] == "m" and 1.5 < numbers["rig"]["person_height_m"] < 2.1
    assert len(numbers["area"]["cam-000"]) == N_FRAMES
    page = (out / "index.html").read_text()
    assert page.count("data:image/") == 2 and "No problems were found" in page and "http" not in page

    rng = np.random.default_rng(1)
    wrong = PLANTS["swapped"](filmed(), rng)
    assert wrong is not None
    other = tmp_path / "other"
    other.mkdir()
    said = call(capsys, "check", other, "--calibration", write_scene(other, wrong[0]), "--out", out)
    assert said.code == 3
    line = next(line for line in said.out.splitlines() if line.startswith("verdict: "))
    assert line.startswith("verdict: swapped cameras: cameras cam-00") and line.endswith("exchange them back")
    assert "swapped cameras" in (out / "index.html").read_text()


def test_what_cannot_be_looked_at_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert call(capsys, "check", tmp_path / "nowhere").complaint == f"{tmp_path / 'nowhere'}: no such folder"
    assert "no recording here" in call(capsys, "check", tmp_path).complaint
    recording = tmp_path / "recording"
    recording.mkdir()
    rig = write_scene(recording, filmed()).rename(tmp_path / "elsewhere.json")
    complaint = call(capsys, "check", recording, "--out", tmp_path / "out").complaint
    assert complaint.startswith(f"{recording / 'setup'}: no such calibration")
    said = call(capsys, "check", recording, "--calibration", rig, "--sample", 2)
    assert "--sample 2: give 3 frames or more" in said.complaint


def test_a_recordings_own_calibration_is_found_as_a_run_finds_it(tmp_path: Path) -> None:
    where = write_scene(tmp_path, filmed())
    assert where.name == "rig.json"
    assert check_recording(tmp_path, at_most=12).findings == ()
    (tmp_path / "calibration").mkdir()
    where.rename(tmp_path / "calibration" / "cameras.json")
    assert check_recording(tmp_path, at_most=12).findings == ()


def test_matrices_that_a_run_converts_are_told_and_nothing_else(tmp_path: Path) -> None:
    scene = replace(filmed(), as_json=False)
    height = scene.rig[0].size[1]
    flip = np.array([[1.0, 0, 0], [0, -1, height - 1], [0, 0, 1]])
    scene.matrices = [flip @ camera.projection_matrix for camera in scene.rig]
    write_scene(tmp_path, scene)
    check = check_recording(tmp_path, at_most=12, units="m")
    assert [(f.kind.value, f.whole_rig) for f in check.findings] == [("mirrored", True)]
    assert "rows counted from the bottom" in check.findings[0].text
    assert "`bodyhull run` undoes that" in check.findings[0].action
    ours = open_recording(tmp_path, units="m").rig
    assert max(c.residual_px or 0.0 for c in check.cameras) < 1.5
    for camera, same in zip(check.facts.rig, ours, strict=True):
        np.testing.assert_allclose(camera.centre, same.centre, atol=1e-9)


def test_a_calibrated_camera_without_pictures_is_told(tmp_path: Path) -> None:
    scene = filmed().copy()
    scene.masks[3] = [None] * N_FRAMES
    check = checked(tmp_path, scene)
    assert [f.sentence() for f in check.findings] == [
        "dead camera: camera cam-003: calibrated, but the recording has no picture of it; restore its "
        "pictures, or take it out of the calibration"
    ]


def test_silhouettes_that_lack_a_part_are_told(tmp_path: Path) -> None:
    scene = filmed().copy()
    for k, mask in enumerate(scene.masks[2]):
        rows = np.flatnonzero(mask.any(axis=1))
        scene.masks[2][k] = mask.copy()
        scene.masks[2][k][rows[0] + int(0.65 * len(rows)) :] = 0
    check = checked(tmp_path, scene)
    assert [(f.kind.value, f.cameras) for f in check.findings] == [("wrong silhouettes", ("cam-002",))]
    assert "they forbid" in check.findings[0].text and check.findings[0].numbers["forbidden"] > 0.1


@pytest.mark.parametrize("n_cameras", [1, 2, 3])
def test_few_cameras_and_few_frames_raise_no_alarm(tmp_path: Path, n_cameras: int) -> None:
    scene = filmed()
    few = replace(
        scene,
        rig=Rig(scene.rig.cameras[:n_cameras]),
        masks=[row[: 3 if n_cameras == 3 else None] for row in scene.masks[:n_cameras]],
    )
    check = checked(tmp_path, few)
    assert check.findings == (), [f.sentence() for f in check.findings]
    assert len(check.cameras) == n_cameras


def test_a_run_of_equal_pictures_counts_only_while_others_move() -> None:
    changed = np.array([[np.nan, 0.1, 0.1, 0.0, 0.0, 0.0, 0.1], *[[np.nan, *[0.1] * 6]] * 3])
    nothing, everything = np.zeros((4, 7), dtype=bool), np.ones((4, 7), dtype=bool)
    facts = FrameFacts(
        tuple(range(7)),
        Rig(filmed().rig.cameras[:4]),
        (1,) * 4,
        everything,
        np.ones((4, 7)),
        changed,
        nothing,
        (),
        {},
    )
    assert [(run.camera_idx, run.first, run.last) for run in frozen_runs(facts)] == [(0, 2, 5)]
    assert frozen_runs(replace(facts, changed=np.vstack([changed[:1], 0 * changed[1:]]))) == []
    assert frozen_runs(replace(facts, border=everything)) == [], "the person may move where nobody sees it"


def test_a_camera_for_smaller_pictures_sees_the_same() -> None:
    camera = filmed().rig[0]
    half = camera.with_pixels_scaled(0.5, 0.5)
    points = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 0.4]])
    corner, half_corner = camera.project(points)[0] + 0.5, half.project(points)[0] + 0.5
    np.testing.assert_allclose(half_corner, corner / 2, atol=1e-9)


def test_a_picture_of_another_size_than_calibrated_is_a_finding_not_an_error(tmp_path: Path) -> None:
    scene = filmed().copy()
    entries = scene.rig.to_json()["cameras"]
    entries[1]["size"] = [75, 90]
    entries[1]["intrinsics"] = (np.diag([0.5, 0.5, 1]) @ np.array(entries[1]["intrinsics"])).tolist()
    check = checked(tmp_path, replace(scene, json_cameras=entries))
    assert [(f.kind.value, f.cameras, f.text) for f in check.findings] == [
        ("half-size calibration", ("cam-001",), "calibrated for 75x90 px, its pictures are 150x180 px")
    ]
    assert cv2.imread(str(tmp_path / "SilhouettesPictures/cam-001/silh_000000.png"), 0).shape == (180, 150)
