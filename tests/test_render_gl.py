"""The off-screen back end: it draws here, and where it does not, the sentence says what to install."""

import sys

import pytest

from render.gl import GlError, choose_platform, probe


def test_a_triangle_is_really_drawn() -> None:
    report = probe()
    assert report.problem is None
    assert report.renderer and report.version


def test_a_back_end_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENGL_PLATFORM", "osmesa")
    report = probe()
    assert report.problem is not None
    assert report.platform == "osmesa"
    assert "apt-get install -y libgl1 libegl1 libegl-mesa0 libgl1-mesa-dri" in report.problem


def test_the_user_s_choice_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    assert choose_platform() == "egl"


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="elsewhere PyOpenGL's own default is used")
def test_too_late_to_choose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYOPENGL_PLATFORM", raising=False)
    monkeypatch.setitem(sys.modules, "OpenGL.platform", sys)
    with pytest.raises(GlError, match="set PYOPENGL_PLATFORM=egl in the environment"):
        choose_platform()
