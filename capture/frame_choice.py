"""Which frames of a recording to take: START:STOP:STEP over frame numbers, as a Python slice."""

from __future__ import annotations

from capture.errors import RecordingError


def choose_frames(available: tuple[int, ...], wanted: str | None) -> tuple[int, ...]:
    """The frame numbers in `available` (ascending) that "START:STOP:STEP" selects; all of them for None or
    "".

    START is included, STOP is not; negative numbers count back from the end; a single number is that frame
    alone. Steps count from START, so a gap in the recording does not shift the frames after it.
    """
    if not available:
        raise RecordingError("the recording has no frame")
    if not wanted:
        return available
    parts = wanted.split(":")
    try:
        numbers = [int(part) if part.strip() else None for part in parts]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 3 or (len(numbers) == 1 and numbers[0] is None):
        raise RecordingError(f"--frames {wanted}: not understood; write START:STOP:STEP, for example 0:100:5")
    end = available[-1] + 1
    start, stop, step = (*numbers, None, None)[:3]
    if len(numbers) == 1:
        assert start is not None
        start = start + end if start < 0 else start
        stop, step = start + 1, 1
    start = available[0] if start is None else (start + end if start < 0 else start)
    stop = end if stop is None else (stop + end if stop < 0 else stop)
    step = 1 if step is None else step
    if step < 1:
        raise RecordingError(f"--frames {wanted}: the step must be 1 or more; a recording is read forwards")
    chosen = tuple(frame for frame in available if start <= frame < stop and (frame - start) % step == 0)
    if not chosen:
        raise RecordingError(
            f"--frames {wanted}: selects nothing; the recording has {len(available)} frames, "
            f"{available[0]} to {available[-1]}"
        )
    return chosen
