"""Off-screen OpenGL: choose the back end before anything imports it, and find out whether it really draws.

pyrender decides on its GL back end when it is imported and a driver that cannot draw may end the whole
process without a Python error. So the choice is made here, in one place, and the question "does it work?" is
put to a child process which draws a triangle and looks at the pixels.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

FIX = (
    "install a driver that draws without a screen, on Debian or Ubuntu: "
    "apt-get install -y libgl1 libegl1 libegl-mesa0 libgl1-mesa-dri"
)
"""What to do when no back end draws."""


class GlError(RuntimeError):
    """No off-screen OpenGL; the text says what was found and what to install."""


@dataclass(frozen=True)
class GlReport:
    """What the probe found.

    `platform` is the PyOpenGL back end, `renderer` and `version` are the driver's own words, `problem` is
    None where a triangle was really drawn and one sentence, with the fixing command, where not.
    """

    platform: str
    renderer: str
    version: str
    problem: str | None


def choose_platform() -> str:
    """Settle PyOpenGL's back end for this process and return its name.

    EGL on Linux unless the user chose one in PYOPENGL_PLATFORM; elsewhere PyOpenGL's own default ("" is
    returned). Must run before the first import of pyrender or OpenGL: afterwards the choice has no effect,
    which is an error when another back end has been loaded already.
    """
    wanted = os.environ.get("PYOPENGL_PLATFORM")
    if wanted is None:
        if not sys.platform.startswith("linux"):
            return ""
        if "OpenGL.platform" in sys.modules:
            raise GlError(
                "OpenGL was imported before bodyhull could choose its off-screen back end: "
                "set PYOPENGL_PLATFORM=egl in the environment"
            )
        os.environ["PYOPENGL_PLATFORM"] = wanted = "egl"
    return wanted


def import_pyrender() -> ModuleType:
    """pyrender with the back end chosen. It imports slowly (a second): only functions that draw call this."""
    choose_platform()
    with warnings.catch_warnings():
        # pyrender and the PyOpenGL it pins warn about old spellings of their own.
        warnings.simplefilter("ignore")
        import pyrender
    return pyrender


def probe(timeout_s: float = 60.0) -> GlReport:
    """Let a child process draw a triangle; report the driver or what went wrong, never raise for it."""
    room = str(Path(__file__).resolve().parent.parent)
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(filter(None, [room, environment.get("PYTHONPATH", "")]))
    platform = environment.get("PYOPENGL_PLATFORM") or (
        "egl" if sys.platform.startswith("linux") else "default"
    )
    try:
        child = subprocess.run(
            [sys.executable, "-m", "render.gl"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return GlReport(
            platform, "", "", f"OpenGL ({platform}) did not answer within {timeout_s:.0f} s: {FIX}"
        )
    lines = child.stdout.strip().splitlines()
    if child.returncode == 0 and lines:
        found = json.loads(lines[-1])
        if found["drawn"]:
            return GlReport(found["platform"], found["renderer"], found["version"], None)
        return GlReport(
            found["platform"],
            found["renderer"],
            found["version"],
            f"OpenGL ({found['platform']}, {found['renderer']}) starts but its triangle has no pixels: {FIX}",
        )
    said = child.stderr.strip().splitlines()
    if child.returncode < 0:
        reason = f"the driver killed the process (signal {-child.returncode})"
    else:
        reason = said[-1] if said else f"exit status {child.returncode}"
    return GlReport(platform, "", "", f"no off-screen OpenGL ({platform}): {reason}; {FIX}")


def _draw_triangle() -> dict[str, object]:
    """Draw one triangle that covers the middle of an 8 x 8 picture; the child's half of `probe`."""
    import numpy as np

    pyrender = import_pyrender()
    from OpenGL import GL

    corners = np.array([[-4.0, -4.0, 0.0], [4.0, -4.0, 0.0], [0.0, 6.0, 0.0]])
    scene = pyrender.Scene(ambient_light=(1.0, 1.0, 1.0))
    scene.add(pyrender.Mesh([pyrender.Primitive(positions=corners, indices=np.array([[0, 1, 2]]), mode=4)]))
    place = np.eye(4)
    place[2, 3] = 2.0
    scene.add(pyrender.OrthographicCamera(2.0, 2.0, znear=0.1, zfar=10.0), pose=place)
    renderer = pyrender.OffscreenRenderer(8, 8)
    _, depth = renderer.render(scene)
    found = {
        "platform": os.environ.get("PYOPENGL_PLATFORM", "default"),
        "renderer": GL.glGetString(GL.GL_RENDERER).decode(),
        "version": GL.glGetString(GL.GL_VERSION).decode(),
        "drawn": bool(depth[4, 4] > 0),
    }
    renderer.delete()
    return found


if __name__ == "__main__":
    print(json.dumps(_draw_triangle()))
