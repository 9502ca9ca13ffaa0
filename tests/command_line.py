"""Calling the command as a shell would, and judging what it says."""

from dataclasses import dataclass

import pytest

from bodyhull.cli import main


@dataclass(frozen=True)
class Said:
    """Exit code and both streams of one call."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """The error's text, which must be one or two lines without a traceback."""
        assert self.code == 1, f"exit code {self.code}, said: {self.err}"
        assert "Traceback" not in self.err
        _, mark, text = self.err.rpartition("bodyhull: error: ")
        assert mark, f"no error line in: {self.err}"
        assert len(text.strip().splitlines()) <= 2, text
        return text.strip()


def call(capsys: pytest.CaptureFixture[str], *words: object) -> Said:
    """Run `bodyhull WORDS` in this process."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    streams = capsys.readouterr()
    code = ended.value.code
    return Said(code if isinstance(code, int) else 0, streams.out, streams.err)
