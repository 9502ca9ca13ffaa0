"""What several files of tests share: one small recording that went through all stages."""

from collections.abc import Iterator

import pytest

from tests.tiny_run import TinyRun, make_tiny_run


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TinyRun]:
    """A run that finished; tests must leave it as it is and change copies (`TinyRun.copy`)."""
    made = make_tiny_run(tmp_path_factory.mktemp("tiny"))
    yield made
    assert made.times() == made.made_times, "a test changed the shared run"
