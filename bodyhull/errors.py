"""What a user can cause: shown in one or two lines, without a traceback."""

from __future__ import annotations


class UserError(Exception):
    """A mistake in what was asked for: the text says what is wrong, where, and what to do."""


#: Exit codes of the command: all well; stopped by an error; finished, but with frames that failed.
OK, ERROR, FRAMES_FAILED = 0, 1, 3
