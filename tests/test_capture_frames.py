"""Frames are chosen as a Python slice over frame numbers."""

import pytest

from capture.frame_choice import choose_frames
from capture.recording import RecordingError

ALL = tuple(range(100))


@pytest.mark.parametrize("text", ["0:100:5", "::", "10:20", ":30:7", "-10:", "5:-5:3", "95:200"])
def test_as_a_slice_of_contiguous_frames(text):
    parts = [int(part) if part else None for part in text.split(":")]
    assert choose_frames(ALL, text) == ALL[slice(*parts)]


def test_numbers_not_positions():
    available = (3, 4, 6, 9, 12)
    assert choose_frames(available, None) == available
    assert choose_frames(available, "3:13:3") == (3, 6, 9, 12)
    assert choose_frames(available, "4::2") == (4, 6, 12)
    assert choose_frames(available, "9") == (9,)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a:b", "--frames a:b: not understood; write START:STOP:STEP"),
        ("1:2:3:4", "not understood"),
        ("0:10:-1", "the step must be 1 or more"),
        ("200:300", "selects nothing; the recording has 100 frames, 0 to 99"),
    ],
)
def test_what_cannot_be_meant_is_told(text, words):
    with pytest.raises(RecordingError, match=words):
        choose_frames(ALL, text)
