"""A body to look at: a turntable of views, and a sheet of its shapes and poses, as one picture.

Every figure stands on its row's floor line and is drawn at the row's scale, so sizes can be compared. Frame:
the body's own (y up, +z front). Cameras stand far away, so that a figure is seen almost without perspective.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from capture.camera import Camera
from capture.layouts import look_at
from fit.body import BodyModel
from fit.body.skeleton import axis_angle_to_matrix, blend_linearly, world_from_rest

from .motions import make_motion
from .scene import Light, Stage, Surface

PAPER = (248, 247, 244)
SKIN = (186, 146, 122)
SUPERSAMPLING = 2  # software drivers leave jagged edges
AMBIENT = 0.10
LIGHTS = (((0.85, 0.75, 0.6), 3.4), ((-0.9, 0.1, 0.5), 0.8))
"""The way a light shines (camera's axes: right, down, forward) and its intensity: one from above the left
shoulder shows the relief, a weak one from the right fills the shadows."""
DISTANCE_M = 40.0
INK = (70, 66, 62)
CAPTION_PX = 24
HEADROOM = 1.06  # a row's height over its tallest figure
N_VIEWS = 8
SHEET_COMPONENTS, SHEET_SD = 5, 2.0
SHEET_POSES: tuple[tuple[str, int], ...] = (
    ("walk", 1), ("lunge", 4), ("squat", 4), ("tilt-twist", 2), ("shoulders-mill", 2), ("a-t-u", 7),
)  # fmt: skip
"""Motion of `motions.MOTIONS`, and which of its eight steps."""
N_STEPS = 8


@dataclass(frozen=True)
class Figure:
    """A posed body in a tile.

    azimuth: where it is seen from, rad, 0 is the front, positive its left; colours: RGB a vertex (V 3), else
    skin.
    """

    vertices: Float[np.ndarray, "v 3"]
    caption: str
    azimuth: float = 0.0
    colours: UInt8[np.ndarray, "v 3"] | None = None


def posed_body(
    model: BodyModel, betas: Float[np.ndarray, "b"], pose: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, "v 3"]:
    """Vertices (m) of these shape coefficients in this pose (rad), correctives included."""
    shaped = model.shaped(betas)
    rotations = axis_angle_to_matrix(pose)
    features = (rotations[1:] - np.eye(3)).reshape(-1)
    bones = world_from_rest(rotations, model.joint_regressor @ shaped)
    return blend_linearly(shaped + model.pose_directions @ features, model.weights, bones)[0]


def turntable(model: BodyModel, *, tile: tuple[int, int] = (260, 360)) -> UInt8[np.ndarray, "h w 3"]:
    """The mean shape, arms lowered, from eight sides, four a row; `tile` is (width, height) px."""
    standing = posed_body(model, np.zeros(0), _arms_lowered())
    views = [
        Figure(standing, f"{round(360 * k / N_VIEWS)} degrees", 2 * np.pi * k / N_VIEWS)
        for k in range(N_VIEWS)
    ]
    half = N_VIEWS // 2
    return draw_rows([views[:half], views[half:]], model.faces, tile)


def sheet(model: BodyModel, *, tile: tuple[int, int] = (200, 330)) -> UInt8[np.ndarray, "h w 3"]:
    """The mean, the first five components at +2 and -2 standard deviations, and six poses."""
    rest = _arms_lowered()
    none = np.zeros(0)
    rows = [
        [Figure(posed_body(model, none, rest), "mean", 0.35)],
        [Figure(posed_body(model, none, rest), "mean", 0.35 + np.pi / 2)],
    ]
    for k in range(min(SHEET_COMPONENTS, model.n_betas)):
        for row, sd in zip(rows, (SHEET_SD, -SHEET_SD), strict=True):
            betas = np.zeros(k + 1)
            betas[k] = sd
            row.append(Figure(posed_body(model, betas, rest), f"shape {k + 1}: {sd:+.0f} SD", 0.35))
    poses = []
    for name, step in SHEET_POSES:
        pose = make_motion(name, N_STEPS).pose[step]
        poses.append(Figure(posed_body(model, none, pose), name, 0.6))
    return draw_rows([*rows, poses], model.faces, tile)


def _arms_lowered() -> Float[np.ndarray, "24 3"]:
    """An A-pose: shapes side by side need less room than in the T-pose."""
    return make_motion("a-t-u", 400).pose[0]


def draw_rows(
    rows: Sequence[Sequence[Figure]], faces: Int[np.ndarray, "f 3"], tile: tuple[int, int]
) -> UInt8[np.ndarray, "h w 3"]:
    """Rows of figures on paper, with their captions. `tile`: width and height of one, px."""
    width, height = tile
    n_columns = max(len(row) for row in rows)
    paper = np.full((height * len(rows), width * n_columns, 3), PAPER, np.uint8)
    large_size = (width * SUPERSAMPLING, (height - CAPTION_PX) * SUPERSAMPLING)
    for i, row in enumerate(rows):
        tall = max(float(np.ptp(figure.vertices[:, 1])) for figure in row)
        broad = max(_breadth(figure) for figure in row)
        half = 0.5 * HEADROOM * max(tall, broad * (height - CAPTION_PX) / width)
        for j, figure in enumerate(row):
            place = paper[i * height : (i + 1) * height, j * width : (j + 1) * width]
            large = _drawn(large_size, figure, faces, half)
            size = (width, height - CAPTION_PX)
            place[:-CAPTION_PX] = cv2.resize(large, size, interpolation=cv2.INTER_AREA)
            _write(place[-CAPTION_PX:], figure.caption)
    return paper


def png_bytes(picture: UInt8[np.ndarray, "h w 3"]) -> bytes:
    """An RGB picture as the content of a PNG file."""
    done, data = cv2.imencode(".png", picture[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
    assert done, "an 8-bit picture can be encoded"
    return data.tobytes()


def _write(strip: UInt8[np.ndarray, "h w 3"], text: str) -> None:
    """Text in the middle of a strip, in place."""
    font, scale = cv2.FONT_HERSHEY_SIMPLEX, 0.42
    (length, tall), _ = cv2.getTextSize(text, font, scale, 1)
    ink = np.zeros(strip.shape[:2], np.uint8)
    cv2.putText(ink, text, ((strip.shape[1] - length) // 2, 6 + tall), font, scale, 255, 1, cv2.LINE_AA)
    share = ink[:, :, None] / 255.0
    strip[:] = np.round(strip * (1 - share) + share * np.array(INK)).astype(np.uint8)


def _sideways(azimuth: float) -> Float[np.ndarray, "3"]:
    """What points to the right in a picture taken from this azimuth."""
    return np.array([np.cos(azimuth), 0.0, -np.sin(azimuth)])


def _breadth(figure: Figure) -> float:
    return float(np.ptp(figure.vertices @ _sideways(figure.azimuth)))


def _drawn(
    size: tuple[int, int], figure: Figure, faces: Int[np.ndarray, "f 3"], half: float
) -> UInt8[np.ndarray, "h w 3"]:
    """One figure; `half` is half of the tile's height in metres, from the floor up."""
    low, high = figure.vertices.min(0), figure.vertices.max(0)
    target = 0.5 * (low + high)
    sideways = _sideways(figure.azimuth)
    across = figure.vertices @ sideways
    target += (0.5 * (across.min() + across.max()) - target @ sideways) * sideways
    target[1] = low[1] + half - (HEADROOM - 1) * half
    towards = np.array([np.sin(figure.azimuth), 0.0, np.cos(figure.azimuth)])
    width, height = size
    focal = 0.5 * height / half * DISTANCE_M
    intrinsics = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    pose = look_at(target + DISTANCE_M * towards, target, np.array([0.0, 1.0, 0.0]))
    camera = Camera("turntable", size, intrinsics, pose, np.zeros(0))
    axes = pose[:3, :3].T
    lights = [Light(axes @ np.array(way), power) for way, power in LIGHTS]
    surface = Surface(figure.vertices, faces, figure.colours, SKIN)
    drawn = Stage([surface], AMBIENT).colour(camera, lights)
    uncovered = (255 - drawn.coverage.astype(np.float64))[:, :, None] / 255
    mixed = drawn.colour + uncovered * np.array(PAPER)
    return np.clip(np.round(mixed), 0, 255).astype(np.uint8)
