"""The colours of a hull's vertices, from the pictures of the cameras that see them.

A camera counts where it looks at the surface from the front, by how much it does, and where nothing of the
hull stands in between. A hull is larger than the person, so some cameras see the background there, or
something behind: the few best cameras' colours are averaged, each the less the farther it is from their
median.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from capture.camera import Camera
from hull.rays import RayScene
from hull.slack import spread_to_neighbours

# So many of the cameras that look most straight at a vertex are asked; of them, the ones that see it count.
_N_ASKED = 5
# Cosine between the normal and the way to the camera: flatter views see mostly what is beside the vertex.
_LEAST_FACING = 0.2
# Rays to the cameras start this far outside (metres), or they would hit the surface they start from.
_LIFT_M = 0.003
# Grey values: colours this far from the median count half.
_HALF_AT = 24.0
# Where no camera sees a vertex and no neighbour is seen either.
_GREY = 128.0


def vertex_colours(
    vertices: Float[np.ndarray, "v 3"],
    faces: Int[np.ndarray, "f 3"],
    normals: Float[np.ndarray, "v 3"],
    cameras: Sequence[Camera],
    picture_of: Callable[[int], UInt8[np.ndarray, "h w 3"] | None],
) -> UInt8[np.ndarray, "v 3"] | None:
    """(V 3) RGB of a closed surface (metres), or None where no picture shows it.

    picture_of : the RGB picture of a camera (its place in `cameras`), as its pinhole sees it, or None. Asked
        for one at a time, since many large ones do not fit into memory. Vertices that no camera sees take
        their neighbours' colour.
    """
    facing, asked = _most_straight(vertices, normals, cameras)
    scene = RayScene(vertices, faces, n_threads=1)
    weight = np.zeros(asked.shape, dtype=np.float32)
    colour = np.zeros((*asked.shape, 3), dtype=np.float32)
    for k, camera in enumerate(cameras):
        place, vertex = np.nonzero(asked == k)
        if not len(vertex) or (picture := picture_of(k)) is None:
            continue
        start = vertices[vertex] + _LIFT_M * normals[vertex]
        free = ~scene.hides(start, camera.centre - start)
        place, vertex = place[free], vertex[free]
        if len(vertex):
            colour[place, vertex] = _sampled(picture, camera.project(vertices[vertex])[0])
            weight[place, vertex] = facing[place, vertex] ** 2
    return _robust_mean(colour, weight, faces) if weight.any() else None


def _most_straight(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], cameras: Sequence[Camera]
) -> tuple[Float[np.ndarray, "k v"], Int[np.ndarray, "k v"]]:
    """(K V) the largest cosines between normal and the way to a camera, and whose they are (-1: none)."""
    n, every = min(_N_ASKED, len(cameras)), np.arange(len(vertices))
    best = np.full((n, len(vertices)), _LEAST_FACING, dtype=np.float32)
    whose = np.full((n, len(vertices)), -1, dtype=np.int16)
    for k, camera in enumerate(cameras):
        facing = _facing(vertices, normals, camera)
        worst = best.argmin(axis=0)
        better = np.flatnonzero(facing > best[worst, every])
        best[worst[better], better] = facing[better]
        whose[worst[better], better] = k
    return best, whose


def _facing(
    vertices: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], camera: Camera
) -> Float[np.ndarray, " v"]:
    """(V,) cosine between normal and the way to the camera; -1 outside of its picture."""
    way = camera.centre - vertices
    cosine = (way * normals).sum(axis=1) / np.linalg.norm(way, axis=1)
    pixels, depth = camera.project(vertices)
    width, height = camera.size
    inside = (depth > 0) & (pixels >= 0).all(axis=1) & (pixels <= [width - 1, height - 1]).all(axis=1)
    return np.where(inside, cosine, -1.0).astype(np.float32)


def _sampled(
    picture: UInt8[np.ndarray, "h w 3"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """(N 3) the picture at the pixels (N 2), bilinear."""
    # In rows, since cv2 addresses pictures with 16 bits.
    n_columns = 16384
    places = np.zeros((-(-len(pixels) // n_columns) * n_columns, 2), dtype=np.float32)
    places[: len(pixels)] = pixels
    x, y = (np.ascontiguousarray(places[:, axis]).reshape(-1, n_columns) for axis in range(2))
    found = np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))
    return found.reshape(-1, 3)[: len(pixels)].astype(np.float32)


def _robust_mean(
    colour: Float[np.ndarray, "k v 3"], weight: Float[np.ndarray, "k v"], faces: Int[np.ndarray, "f 3"]
) -> UInt8[np.ndarray, "v 3"]:
    seen = weight > 0
    order = np.where(seen[:, :, None], colour, np.inf)
    order.sort(axis=0)
    n_seen = seen.sum(axis=0)
    middle = np.maximum(n_seen - 1, 0) // 2
    median = np.take_along_axis(order, middle[None, :, None], axis=0)[0]
    far = np.abs(colour - np.where(n_seen[:, None] > 0, median, 0.0)).max(axis=2)
    weight = weight / (1.0 + (far / _HALF_AT) ** 2)
    total = weight.sum(axis=0)
    mean = np.einsum("kv,kvc->vc", weight, colour) / np.maximum(total, 1e-12)[:, None]
    mean[n_seen == 0] = np.nan
    if n_seen.any() and (n_seen == 0).any():
        mean = np.column_stack([spread_to_neighbours(mean[:, channel], faces) for channel in range(3)])
    return np.clip(np.round(np.nan_to_num(mean, nan=_GREY)), 0, 255).astype(np.uint8)
