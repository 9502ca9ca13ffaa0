"""Films: what is written can be read back, opens in a browser, and is there whole or not at all."""

from pathlib import Path

import av
import numpy as np
import pytest

from render.video import even_size, write_video


def moving_square(n_frames: int, size: tuple[int, int]) -> list[np.ndarray]:
    frames = []
    for k in range(n_frames):
        frame = np.full((size[1], size[0], 3), (40, 90, 160), np.uint8)
        frame[20:44, 4 * k : 4 * k + 24] = (230, 200, 60)
        frames.append(frame)
    return frames


def test_round_trip(tmp_path: Path) -> None:
    frames = moving_square(9, (97, 71))
    path = write_video(tmp_path / "deep" / "film.mp4", frames, 12.5, quality=8)
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
        assert (stream.width, stream.height) == (98, 72)
        assert stream.average_rate == 12.5
        read = [picture.to_ndarray(format="rgb24") for picture in film.decode(stream)]
    assert len(read) == len(frames)
    for written, found in zip(frames, read, strict=True):
        error = np.abs(found[:71, :97].astype(int) - written)
        assert np.median(error) <= 2 and (error > 12).mean() < 0.05, "colours or places moved"


def test_the_index_comes_before_the_pictures(tmp_path: Path) -> None:
    content = write_video(tmp_path / "film.mp4", moving_square(5, (64, 64)), 25).read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


def test_even_size_repeats_the_last_row_and_column() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    even = even_size(frame)
    assert even.shape == (6, 8, 3)
    assert np.array_equal(even[:5, :7], frame)
    assert np.array_equal(even[5, :7], frame[4]) and np.array_equal(even[:5, 7], frame[:, 6])


def test_a_film_breaks_off_and_leaves_nothing(tmp_path: Path) -> None:
    def frames():
        yield from moving_square(3, (64, 64))
        raise RuntimeError("camera gone")

    old = write_video(tmp_path / "film.mp4", moving_square(2, (64, 64))).read_bytes()
    with pytest.raises(RuntimeError, match="camera gone"):
        write_video(tmp_path / "film.mp4", frames())
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]
    assert (tmp_path / "film.mp4").read_bytes() == old


@pytest.mark.parametrize(
    ("frames", "fps", "says"),
    [
        ([], 25, "film.mp4: no frame to write"),
        ([np.zeros((8, 8, 3), np.uint8)], 0, "0 pictures a second make no film"),
        ([np.zeros((8, 8), np.uint8)], 25, r"frame 0 is uint8 of shape \(8, 8\); expected uint8"),
        ([np.zeros((8, 8, 3))], 25, "frame 0 is float64"),
        (
            [np.zeros((8, 8, 3), np.uint8), np.zeros((10, 8, 3), np.uint8)],
            25,
            "frame 1 has size 8 x 10, the ones before 8 x 8",
        ),
    ],
)
def test_what_cannot_be_a_film(tmp_path: Path, frames: list, fps: float, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        write_video(tmp_path / "film.mp4", frames, fps)
    assert list(tmp_path.iterdir()) == []
