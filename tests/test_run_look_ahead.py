"""Reading ahead gives what reading frame by frame gives; a bad file marks its own frame only."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyhull.carving import carve_stage
from bodyhull.config import RunConfig
from bodyhull.folder import RunFolder
from bodyhull.look_ahead import silhouettes_ahead
from capture.layouts import ring_layout
from capture.recording import Silhouettes
from tests.hull_subjects import ball

N_FRAMES, DAMAGED, EMPTY = 6, 2, 4


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball that moves, seen by six cameras; one file is cut short, and one frame is lost in all cameras."""
    root = tmp_path_factory.mktemp("ball")
    rig = ring_layout(6, (160, 160))
    rig.save(root / "rig.json")
    for frame in range(N_FRAMES):
        for camera, image in zip(rig, ball(0.3, (0.05 * frame, 0, 1.0)).silhouettes(rig), strict=True):
            folder = root / "SilhouettesPictures" / camera.name
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"silh_{frame:06d}.png"
            cv2.imwrite(str(path), image)
            if frame == EMPTY or (frame == DAMAGED and camera is rig[1]):
                path.write_bytes(path.read_bytes()[:60])
    return root


def _config(recording: Path, out: Path) -> RunConfig:
    return RunConfig(
        recording=recording, out=out, calibration=recording / "rig.json", voxel_mm=25.0, units="m", up="z"
    )


def test_a_bad_file_read_ahead_marks_its_frame_only(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    carve_stage(_config(recording, tmp_path / "ahead"))
    frames = RunFolder(tmp_path / "ahead").stage("hull")["frames"]
    statuses = {int(k): entry["status"] for k, entry in frames.items()}
    assert statuses == {
        k: "degraded" if k == DAMAGED else "failed" if k == EMPTY else "ok" for k in range(N_FRAMES)
    }
    assert "PNG is truncated" in frames[f"{DAMAGED:06d}"]["problems"][0]
    # The same frames, one by one and without help from the frame before.
    for frame in range(N_FRAMES):
        alone = replace(_config(recording, tmp_path / f"alone{frame}"), frames=f"{frame}:{frame + 1}")
        if frame == EMPTY:
            continue
        carve_stage(alone)
        one = RunFolder(alone.out)
        assert one.hull(frame).read_bytes() == RunFolder(tmp_path / "ahead").hull(frame).read_bytes()
        assert one.stage("hull")["frames"][f"{frame:06d}"] == frames[f"{frame:06d}"]


@dataclass
class Source:
    """Stands in for a recording: remembers what was read, and when."""

    read: list[int] = field(default_factory=list)
    threads: set[str] = field(default_factory=set)
    bad: int = -1
    seconds: float = 0.0

    def silhouettes(self, frame_id: int) -> Silhouettes:
        if frame_id == self.bad:
            raise OSError(f"frame {frame_id}: the disk is gone")
        time.sleep(self.seconds)
        self.read.append(frame_id)
        self.threads.add(threading.current_thread().name)
        return Silhouettes(frame_id, (np.full((2, 2), frame_id, dtype=np.uint8),), ())


@pytest.mark.parametrize("n_ahead", [0, 1, 2, 9])
def test_frames_come_in_order_and_no_more_than_asked_for_are_held(n_ahead: int) -> None:
    source = Source()
    seen = []
    with silhouettes_ahead(source.silhouettes, range(6), n_ahead) as frames:
        for n_done, silhouettes in enumerate(frames):
            assert len(source.read) <= n_done + 1 + n_ahead
            time.sleep(0.01)
            seen.append(silhouettes.frame_id)
            assert int(silhouettes.images[0][0, 0]) == silhouettes.frame_id  # type: ignore[index]
    assert seen == source.read == list(range(6))
    assert len(source.threads) == 1


def test_an_error_in_the_reading_thread_is_raised_at_its_frame() -> None:
    source = Source(bad=3)
    seen = []
    with (
        pytest.raises(OSError, match="frame 3: the disk is gone"),
        silhouettes_ahead(source.silhouettes, range(6), 2) as frames,
    ):
        seen += [silhouettes.frame_id for silhouettes in frames]
        raise AssertionError("the error was swallowed")
    assert [*seen, *source.read[:3]][:3] == [0, 1, 2]


def test_leaving_early_reads_no_further() -> None:
    """As with Ctrl-C while a frame is carved."""
    source = Source(seconds=0.02)
    with pytest.raises(KeyboardInterrupt), silhouettes_ahead(source.silhouettes, range(50), 2) as frames:
        next(frames)
        raise KeyboardInterrupt
    time.sleep(0.2)
    assert len(source.read) <= 4
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("silhouettes")]
