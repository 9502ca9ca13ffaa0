"""Draw meshes as a recording's own camera sees them: colour, silhouette and depth, off screen, through
pyrender.

The one place that knows OpenGL's axes (y up, z backwards) and its pixel rectangle (the first pixel spans 0 to
1): everything else speaks `capture.Camera` (y down, z forward, (0, 0) the centre of the first pixel). The
clip matrix is derived from the camera's exact 3x4 projection, so skew, unequal focal lengths and any
principal point are exact.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Integer, UInt8

from capture.camera import Camera
from capture.layouts import look_at
from fit.surface import vertex_normals

from .gl import FIX, GlError, import_pyrender

NEAREST_M = 0.02
"""Nothing closer to a camera than this is drawn (m): a vertex at the camera's centre has no picture."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh with its look.

    vertices: metres, world frame. colours: RGB a vertex, or None for `colour` everywhere. roughness: 0
    mirror, 1 chalk. two_sided: may be seen from behind; one that is closed and faces outwards draws faster
    without.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Integer[np.ndarray, "f 3"]
    colours: UInt8[np.ndarray, "v 3"] | None = None
    colour: tuple[int, int, int] = (196, 164, 142)
    roughness: float = 0.8
    two_sided: bool = True


@dataclass(frozen=True)
class Light:
    """Light from infinitely far. direction: the way it shines, world frame (any length). intensity:
    pyrender's units.
    """

    direction: Float[np.ndarray, " 3"]
    intensity: float
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Picture:
    """What a camera sees. colour: RGB with anti-aliased edges on black; coverage: share of the pixel that is
    covered, 0..255 (blend with it); mask: the surface is hit by the ray through the pixel's centre; depth:
    metres along the optical axis, 0 where nothing is hit.
    """

    colour: UInt8[np.ndarray, "h w 3"]
    coverage: UInt8[np.ndarray, "h w"]
    mask: Bool[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]


@functools.cache
def _offscreen() -> Any:
    """The process's one GL context. pyrender ends the whole display when any of its renderers is deleted, so
    there is one for all, made at the first picture; its framebuffer follows the size asked for.
    """
    pyrender = import_pyrender()
    try:
        return pyrender.OffscreenRenderer(16, 16)
    except Exception as error:  # drivers raise whatever they like
        raise GlError(
            f"no off-screen OpenGL ({type(error).__name__}: {error}); run `bodyhull doctor`, or {FIX}"
        ) from error


@functools.cache
def _clip_camera_class() -> type:
    """A pyrender camera whose projection is a given matrix (pyrender's own pinhole knows no skew)."""
    pyrender = import_pyrender()

    class ClipCamera(pyrender.IntrinsicsCamera):
        def __init__(self, clip_from_view: np.ndarray, near: float, far: float) -> None:
            super().__init__(1.0, 1.0, 0.0, 0.0, znear=near, zfar=far)
            self.clip_from_view = clip_from_view

        def get_projection_matrix(self, width: Any = None, height: Any = None) -> np.ndarray:
            return self.clip_from_view

    return ClipCamera


GL_FROM_CV = np.diag([1.0, -1.0, -1.0, 1.0])
"""OpenGL's eye axes (y up, z towards the eye) from the camera's (y down, z forward)."""


def clip_from_world(
    projection: Float[np.ndarray, "3 4"], size: tuple[int, int], near: float, far: float
) -> Float[np.ndarray, "4 4"]:
    """OpenGL's clip matrix of a projection whose third row is metric depth (px; near, far in metres).

    OpenGL's window runs from 0 to width across pixels whose centres lie at halves: hence the half pixel.
    """
    width, height = size
    u, v, depth = projection
    return np.stack(
        [
            (2.0 / width) * (u + 0.5 * depth) - depth,
            depth - (2.0 / height) * (v + 0.5 * depth),
            (far + near) / (far - near) * depth - np.array([0.0, 0.0, 0.0, 2.0 * far * near / (far - near)]),
            depth,
        ]
    )


def lights_of_camera(camera: Camera) -> tuple[Light, ...]:
    """A key light over the camera's left shoulder and a weak one from its right: shapes read well from
    anywhere.
    """
    axes = camera.camera_from_world[:3, :3]
    return (
        Light(axes.T @ np.array([0.55, 0.6, 1.0]), 2.6),
        Light(axes.T @ np.array([-0.8, 0.1, 1.0]), 0.9),
    )


def studio_lights(up: Float[np.ndarray, " 3"]) -> tuple[Light, ...]:
    """Four soft lights that stay where they are in the room: a key, two fills and one from above."""
    up = np.asarray(up, float) / np.linalg.norm(up)
    side = np.cross(up, [0.3, 0.5, 0.8] if abs(up[1]) < 0.9 else [1.0, 0.2, 0.1])
    side = side / np.linalg.norm(side)
    front = np.cross(side, up)
    return (
        Light(-up - 0.9 * side - 0.8 * front, 2.0, (1.0, 0.97, 0.92)),
        Light(-0.5 * up + side - 0.5 * front, 1.1, (0.93, 0.96, 1.0)),
        Light(-0.4 * up + 0.3 * side + front, 1.2),
        Light(-up, 0.6),
    )


class Stage:
    """Meshes on the graphics card, ready for any number of cameras.

    Positions are taken relative to the meshes' middle before they become single precision, so that a world
    whose origin lies far away costs no accuracy.
    """

    def __init__(self, surfaces: Sequence[Surface], ambient: float = 0.28) -> None:
        pyrender = import_pyrender()
        drawn = [s for s in surfaces if len(s.vertices) and len(s.faces)]
        self._points = np.concatenate([s.vertices for s in drawn]) if drawn else np.zeros((0, 3))
        self._middle = self._points.mean(0) if len(self._points) else np.zeros(3)
        self._points = self._points - self._middle
        self._scene = pyrender.Scene(bg_color=(0.0, 0.0, 0.0, 0.0), ambient_light=(ambient,) * 3)
        self._nodes = [self._scene.add(self._mesh(pyrender, s)) for s in drawn]
        # pyrender draws no back faces in its mask pass, whatever the material says: it gets them turned round
        turned = [replace(s, faces=s.faces[:, ::-1]) for s in drawn if s.two_sided]
        self._backs = [self._scene.add(self._mesh(pyrender, s)) for s in turned]
        self._lights: list[Any] = []
        self._eye: Any = None
        self._window = (0, 0, 1, 1)

    def _mesh(self, pyrender: Any, surface: Surface) -> Any:
        factor = (1.0, 1.0, 1.0) if surface.colours is not None else tuple(c / 255.0 for c in surface.colour)
        material = pyrender.MetallicRoughnessMaterial(
            baseColorFactor=(*factor, 1.0),
            metallicFactor=0.0,
            roughnessFactor=surface.roughness,
            doubleSided=surface.two_sided,
        )
        colours = None
        if surface.colours is not None:
            colours = np.concatenate([surface.colours / 255.0, np.ones((len(surface.vertices), 1))], 1)
        primitive = pyrender.Primitive(
            positions=(surface.vertices - self._middle).astype(np.float32),
            normals=vertex_normals(surface.vertices, surface.faces).astype(np.float32),
            color_0=None if colours is None else colours.astype(np.float32),
            indices=surface.faces.astype(np.uint32),
            material=material,
            mode=4,
        )
        return pyrender.Mesh([primitive])

    def colour(self, camera: Camera, lights: Sequence[Light] | None = None) -> Picture:
        """The picture, lit by `lights`: those of `lights_of_camera` where None; the colours as they are where
        empty.

        ValueError for a camera with distortion.
        """
        pyrender = import_pyrender()
        depth = self._depth_at_centres(camera)
        for node in self._lights:
            self._scene.remove_node(node)
        self._lights = [
            self._scene.add(
                pyrender.DirectionalLight(color=light.colour, intensity=light.intensity), pose=_aim(light)
            )
            for light in (lights_of_camera(camera) if lights is None else lights)
        ]
        for node in self._backs:
            node.mesh.is_visible = False
        flags = pyrender.RenderFlags.RGBA
        if not self._lights:
            flags |= pyrender.RenderFlags.FLAT
        rgba, _ = _offscreen().render(self._scene, flags)
        rgba = self._pasted(rgba, camera)
        return Picture(rgba[:, :, :3], rgba[:, :, 3], depth > 0, depth)

    def silhouette(self, camera: Camera) -> tuple[Bool[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
        """(mask, depth) sampled at pixel centres. ValueError for a camera with distortion."""
        depth = self._depth_at_centres(camera)
        return depth > 0, depth

    def _depth_at_centres(self, camera: Camera) -> Float32[np.ndarray, "h w"]:
        """Depth without multisampling: with it, the depth is that of a sample off the pixel's centre."""
        pyrender = import_pyrender()
        self._place(camera)
        offscreen = _offscreen()
        offscreen.viewport_width, offscreen.viewport_height = self._window[2:]
        for node in self._backs:
            node.mesh.is_visible = True
        nodes = dict.fromkeys(self._nodes + self._backs, 255)
        _, depth = offscreen.render(self._scene, pyrender.RenderFlags.SEG, nodes)
        return self._pasted(depth, camera)

    def _pasted(self, part: np.ndarray, camera: Camera) -> np.ndarray:
        """The drawn window in an otherwise empty picture of the camera's size."""
        column, row, width, height = self._window
        whole = np.zeros((camera.size[1], camera.size[0], *part.shape[2:]), part.dtype)
        whole[row : row + height, column : column + width] = part
        return whole

    def _place(self, camera: Camera) -> None:
        """Point the eye: the window of the picture that the meshes fall into, and the planes around them."""
        if camera.distortion.size and np.any(camera.distortion):
            raise ValueError(
                f"camera {camera.name} has lens distortion, which a straight-line renderer cannot draw: "
                "render camera.pinhole() and undistort the picture (camera.undistort_image)"
            )
        shift = np.eye(4)
        shift[:3, 3] = self._middle
        projection = camera.projection_matrix @ shift
        seen = self._points @ projection[:, :3].T + projection[:, 3]
        ahead = seen[seen[:, 2] > NEAREST_M]
        near, far = (0.98 * ahead[:, 2].min(), 1.02 * ahead[:, 2].max()) if len(ahead) else (0.1, 10.0)
        self._window = (0, 0, *camera.size)
        if len(ahead) < len(seen):
            near = NEAREST_M
        elif len(ahead):
            self._window = _window_around(ahead[:, :2] / ahead[:, 2:], camera.size)
        column, row, width, height = self._window
        projection = projection - np.outer([column, row, 0.0], projection[2])
        world_from_view = np.linalg.inv(GL_FROM_CV @ camera.camera_from_world @ shift)
        clip_from_view = clip_from_world(projection, (width, height), near, far) @ world_from_view
        if self._eye is not None:
            self._scene.remove_node(self._eye)
        eye = _clip_camera_class()(clip_from_view, float(near), float(far))
        self._eye = self._scene.add(eye, pose=world_from_view)


def _window_around(pixels: Float[np.ndarray, "n 2"], size: tuple[int, int]) -> tuple[int, int, int, int]:
    """(column, row, width, height) of the part of a picture that holds these pixels with a margin.

    A person fills a tenth of a picture; drawing in software costs by the pixel. Steps of 32 pixels, so that
    the framebuffer is seldom made anew.
    """
    window = []
    for low, high, limit in zip(pixels.min(0) - 3, pixels.max(0) + 3, size, strict=True):
        start = int(np.clip(np.floor(low), 0, limit - 1))
        stop = int(np.clip(np.ceil(high), start + 1, limit))
        length = min(-(-(stop - start) // 32) * 32, limit)
        window.append((min(start, limit - length), length))
    return window[0][0], window[1][0], window[0][1], window[1][1]


class Renderer:
    """Pictures of one size. Cheap to make: the GL context is the process's one. Use it from one thread."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (int(width), int(height))

    def colour(
        self, meshes: Sequence[Surface], camera: Camera, lights: Sequence[Light] | None = None
    ) -> Picture:
        """Lit picture, mask and depth of the meshes as `camera` (a pinhole of this renderer's size) sees
        them.
        """
        self._check(camera)
        return Stage(meshes).colour(camera, lights)

    def silhouette(
        self, meshes: Sequence[Surface], camera: Camera
    ) -> tuple[Bool[np.ndarray, "h w"], Float32[np.ndarray, "h w"]]:
        """(mask, depth in metres) sampled at pixel centres; depth 0 where nothing is hit."""
        self._check(camera)
        return Stage(meshes).silhouette(camera)

    def stage(self, meshes: Sequence[Surface]) -> Stage:
        """The meshes uploaded once, for many cameras."""
        return Stage(meshes)

    def _check(self, camera: Camera) -> None:
        if tuple(camera.size) != self.size:
            raise ValueError(
                f"camera {camera.name} has pictures of {camera.size[0]} x {camera.size[1]}, "
                f"the renderer draws {self.size[0]} x {self.size[1]}: make one renderer a size"
            )


def _aim(light: Light) -> Float[np.ndarray, "4 4"]:
    """Pose of a pyrender light, which shines along its own -z."""
    forward = np.asarray(light.direction, float)
    sideways = [1.0, 0.0, 0.0] if abs(forward[0]) < 0.9 * np.linalg.norm(forward) else [0.0, 1.0, 0.0]
    return np.linalg.inv(GL_FROM_CV @ look_at(np.zeros(3), forward, np.array(sideways)))
