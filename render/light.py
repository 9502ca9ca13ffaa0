"""Light worked out at the vertices: matte shading and cast shadows, baked into the colours once a frame.

A synthetic film draws the same dressed person for every camera. Shading in a software driver costs by the
triangle and by the camera; matte light does not depend on the camera, so it is computed here once and drawn
flat ten times as fast, and there is time left for shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from fit.surface import vertex_normals

from .scene import Light, Surface

SHADOW_START_M = 0.006
"""Shadow rays begin this far off the surface (m), beyond the next layer of thin cloth's grazing hits."""
EXPOSURE = 0.36
"""Share of a colour that one unit of light intensity, falling straight on, gives back."""


def bake(surfaces: Sequence[Surface], lights: Sequence[Light], ambient: float = 0.42) -> list[Surface]:
    """The surfaces with light and shadow in their colours; draw them with no lights.

    ambient: share of light from everywhere, somewhat more from where the lights are on average (above).
    """
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene(nthreads=0)
    for surface in surfaces:
        scene.add_triangles(
            o3d.core.Tensor.from_numpy(surface.vertices.astype(np.float32)),
            o3d.core.Tensor.from_numpy(surface.faces.astype(np.uint32)),
        )
    points = np.concatenate([s.vertices for s in surfaces])
    normals = np.concatenate([vertex_normals(s.vertices, s.faces) for s in surfaces])
    towards = [-np.asarray(light.direction) / np.linalg.norm(light.direction) for light in lights]
    sky = np.sum(towards, 0)
    sky = sky / max(float(np.linalg.norm(sky)), 1e-9)
    arriving = np.repeat(ambient * (0.75 + 0.25 * (normals @ sky))[:, None], 3, 1)
    for light, direction in zip(lights, towards, strict=True):
        facing = normals @ direction
        lit = np.flatnonzero(facing > 0)
        lit = lit[~_shadowed(scene, points[lit], normals[lit], direction)]
        arriving[lit] += EXPOSURE * light.intensity * facing[lit, None] * np.asarray(light.colour)
    out, start = [], 0
    for surface in surfaces:
        stop = start + len(surface.vertices)
        own = surface.colours if surface.colours is not None else np.array([surface.colour])
        colours = np.clip(own * _tone(arriving[start:stop]), 0, 255).astype(np.uint8)
        out.append(replace(surface, colours=colours))
        start = stop
    return out


def _tone(light: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Light to a share of the colour: straight up to a half, then bending towards 1 as film does."""
    return np.where(light < 0.5, light, 1.0 - 0.25 / np.maximum(light, 0.5))


def _shadowed(
    scene: object, points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], direction: np.ndarray
) -> Bool[np.ndarray, " n"]:
    """Whether something stands between each point and the light."""
    import open3d as o3d

    start = points + SHADOW_START_M * (normals + direction)
    rays = np.concatenate([start, np.broadcast_to(direction, start.shape)], 1).astype(np.float32)
    return scene.test_occlusions(o3d.core.Tensor.from_numpy(rays)).numpy()  # type: ignore[attr-defined]
