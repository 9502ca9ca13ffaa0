"""Films that open everywhere: H.264, 4:2:0, in MP4 with its index in front, through PyAV."""

from __future__ import annotations

from collections.abc import Iterable, Sized
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from tqdm import tqdm


def write_video(
    path: Path | str,
    frames: Iterable[np.ndarray],
    fps: float | int = 25,
    *,
    quality: int = 20,
    progress: str | None = None,
) -> Path:
    """Encode RGB frames (all of one size) to an MP4 and return its path.

    H.264 in 4:2:0 needs even sizes: an odd last column or row is repeated once. The index goes in front of
    the pictures ("faststart"), so that a browser can start before it has everything. The file is written
    under a temporary name next to it and renamed, so a film that exists is whole.

    fps: pictures a second. quality: x264's constant rate factor, lower is better (0 lossless, 20 good).
    progress: label of a progress bar, none where None. ValueError where there is no frame, or where one has
    another size or type.
    """
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc, VideoReformatter

    path = Path(path)
    if fps <= 0:
        raise ValueError(f"{path}: {fps} pictures a second make no film; give a positive number")
    partial = path.with_name(f".{path.stem}.partial{path.suffix or '.mp4'}")
    path.parent.mkdir(parents=True, exist_ok=True)
    total = len(frames) if isinstance(frames, Sized) else None
    shown = tqdm(frames, desc=progress, total=total, unit="frame", disable=progress is None, leave=False)
    shape: tuple[int, ...] | None = None
    to_yuv = VideoReformatter()
    try:
        with av.open(str(partial), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
            for frame_idx, frame in enumerate(shown):
                if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
                    raise ValueError(
                        f"{path}: frame {frame_idx} is {frame.dtype} of shape {frame.shape}; "
                        "expected uint8 of height x width x 3 (RGB)"
                    )
                if shape is None:
                    shape = frame.shape
                    stream.height, stream.width = (n + n % 2 for n in shape[:2])
                    stream.pix_fmt = "yuv420p"
                    stream.options = {"crf": str(quality), "preset": "veryfast"}
                    # Untagged films are taken for BT.601 or BT.709 by their size: say which, or colours
                    # shift.
                    stream.codec_context.colorspace = Colorspace.ITU709
                    stream.codec_context.color_range = ColorRange.MPEG
                    stream.codec_context.color_primaries = ColorPrimaries.BT709
                    stream.codec_context.color_trc = ColorTrc.BT709
                elif frame.shape != shape:
                    raise ValueError(
                        f"{path}: frame {frame_idx} has size {frame.shape[1]} x {frame.shape[0]}, "
                        f"the ones before {shape[1]} x {shape[0]}"
                    )
                picture = to_yuv.reformat(
                    av.VideoFrame.from_ndarray(even_size(frame), format="rgb24"),
                    format="yuv420p",
                    src_color_range=ColorRange.JPEG,
                    dst_color_range=ColorRange.MPEG,
                    dst_colorspace=Colorspace.ITU709,
                )
                container.mux(stream.encode(picture))
            if shape is None:
                raise ValueError(f"{path}: no frame to write")
            container.mux(stream.encode())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return path


def even_size(frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The frame with its last column and row repeated where that makes its size even."""
    height, width = frame.shape[:2]
    if height % 2 or width % 2:
        frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    return np.ascontiguousarray(frame)
