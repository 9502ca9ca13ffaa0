"""Boards drawn as cameras with real lenses would see them, and corners of boards without pictures."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from capture.board import Board
from capture.board_view import BoardView, Sightings
from capture.camera import Camera
from capture.layouts import look_at
from capture.rig import Rig

_PX_PER_SQUARE = 80
CHECKERBOARD = Board("checkerboard", 9, 6, 0.1)
CHARUCO = Board("charuco", 7, 6, 0.12, 0.09, "DICT_5X5_50")
LEGACY = Board("charuco", 7, 6, 0.12, 0.09, "DICT_5X5_50", legacy=True)


def board_picture(board: Board) -> np.ndarray:
    """The board as printed, a white border of one square around it; `_PX_PER_SQUARE` pixels a square."""
    px = _PX_PER_SQUARE
    if board.kind == "charuco":
        size = (board.columns * px, board.rows * px)
        plain = board.charuco().generateImage(size, marginSize=0, borderBits=1)
    else:
        down, across = np.indices((board.rows, board.columns))
        plain = np.where((down + across) % 2 == 0, 0, 255).astype(np.uint8).repeat(px, 0).repeat(px, 1)
    return cv2.copyMakeBorder(plain, px, px, px, px, cv2.BORDER_CONSTANT, value=255)


def film_board(
    camera: Camera,
    board: Board,
    world_from_board: np.ndarray,
    rng: np.random.Generator,
    *,
    blur_px: float = 0.6,
    noise: float = 2.0,
) -> np.ndarray:
    """A grey picture (h w) of the board in front of a mottled background, through the camera's lens."""
    sharp = camera.pinhole()
    px = _PX_PER_SQUARE
    printed = board_picture(board)
    # Board plane (metres) from the drawing's pixels, whose edges lie at half numbers.
    scale = board.square_m / px
    plane_from_drawing = np.array(
        [[scale, 0, (0.5 - px) * scale], [0, scale, (0.5 - px) * scale], [0, 0, 1.0]]
    )
    camera_from_board = camera.camera_from_world @ world_from_board
    if camera_from_board[:3, 2] @ camera_from_board[:3, 3] <= 0:
        printed = np.full_like(printed, 255)  # seen from behind
    homography = sharp.intrinsics @ camera_from_board[:3, [0, 1, 3]] @ plane_from_drawing
    width, height = camera.size
    # Drawn at twice the size, then through the lens at once, so that the board is resampled only once more.
    fine = 2
    up = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1.0]])
    margin = np.array([[1, 0, 0.15 * width], [0, 1, 0.15 * height], [0, 0, 1.0]])
    canvas = (round(1.3 * width * fine), round(1.3 * height * fine))
    mottled = cv2.GaussianBlur(
        rng.uniform(60, 180, (height // 16, width // 16)).astype(np.float32), (0, 0), 1
    )
    background = cv2.resize(mottled, canvas, interpolation=cv2.INTER_LINEAR)
    to_canvas = up @ margin @ homography
    drawn = cv2.warpPerspective(
        printed.astype(np.float32), to_canvas, canvas, flags=cv2.INTER_AREA, borderValue=-1.0
    )
    inside = cv2.warpPerspective(np.ones_like(printed, np.float32), to_canvas, canvas)
    canvas_picture = np.where(inside > 0.99, 20 + 0.8 * drawn, background).astype(np.float32)
    canvas_picture = cv2.GaussianBlur(canvas_picture, (0, 0), 0.5 * fine)
    source = (_straight_pixels(camera) + np.array([0.15 * width, 0.15 * height])) * fine + (fine - 1) / 2
    source = source.reshape(height, width, 2).astype(np.float32)
    picture = cv2.remap(canvas_picture, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
    if blur_px > 0:
        picture = cv2.GaussianBlur(picture, (0, 0), blur_px)
    picture = picture + rng.normal(0, noise, picture.shape)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


@lru_cache(maxsize=32)
def _straight_pixels(camera: Camera) -> np.ndarray:
    """Where a camera without the lens sees what this one sees at each of its pixels (N 2), row by row."""
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    return camera.undistort(pixels.astype(np.float64))


def ring(
    n_cameras: int,
    size: tuple[int, int] = (640, 480),
    *,
    focal: float = 620.0,
    distance_m: float = 2.0,
    height_m: float = 1.3,
    aim_m: float = 1.0,
) -> Rig:
    """Cameras with lenses on an arc of a ring, aimed at a place above the floor; each somewhat different."""
    cameras = []
    for k in range(n_cameras):
        angle = 2 * np.pi * k / max(n_cameras, 8)
        centre = np.array([distance_m * np.cos(angle), distance_m * np.sin(angle), height_m + 0.3 * (k % 2)])
        pose = look_at(centre, np.array([0.0, 0, aim_m]), np.array([0.0, 0, 1]))
        f = focal * (1 + 0.01 * ((3 * k) % 5 - 2))
        intrinsics = np.array(
            [
                [f, 0, size[0] / 2 - 0.5 + 4 * ((k % 3) - 1)],
                [0, f, size[1] / 2 - 0.5 + 3 * (k % 2)],
                [0, 0, 1],
            ]
        )
        distortion = np.array([-0.12 + 0.01 * (k % 3), 0.08, 4e-4, -3e-4])
        cameras.append(Camera(f"cam{k + 1}", size, intrinsics, pose, distortion))
    return Rig(tuple(cameras))


def held_board(
    board: Board,
    rng: np.random.Generator,
    towards: np.ndarray,
    *,
    spread_m: float = 0.35,
    tilt_deg: float = 30.0,
) -> np.ndarray:
    """world_from_board (4 4): somewhere around (0, 0, 1), its front roughly towards a point, tilted and
    rolled."""
    centre = np.array([0, 0, 1.0]) + rng.uniform(-spread_m, spread_m, 3)
    away = centre - towards
    pose = np.linalg.inv(look_at(np.zeros(3), away, np.array([0.0, 0, 1])))
    tilt = cv2.Rodrigues(np.radians(rng.uniform(-tilt_deg, tilt_deg, 3)))[0]
    rotation = pose[:3, :3] @ tilt
    middle = np.array([board.columns, board.rows, 0]) * board.square_m / 2
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = centre - rotation @ middle
    return out


def seen_corners(
    camera: Camera, board: Board, world_from_board: np.ndarray, rng: np.random.Generator, noise_px: float
) -> BoardView | None:
    """The corners as a detector with this noise would give them: None unless front, whole and not too
    steep."""
    facing = (camera.camera_from_world @ world_from_board)[:3, :3]
    points = board.corners @ world_from_board[:3, :3].T + world_from_board[:3, 3]
    pixels, depth = camera.project(points)
    direction = (camera.camera_from_world @ np.append(points.mean(0), 1))[:3]
    if facing[:, 2] @ direction < 0.35 * np.linalg.norm(direction) or depth.min() < 0.2:
        return None
    margin = 4
    inside = np.isfinite(pixels).all(1) & (pixels > margin).all(1)
    inside &= (pixels < np.array(camera.size) - 1 - margin).all(1)
    if (board.kind == "checkerboard" and not inside.all()) or inside.sum() < 12:
        return None
    ids = np.flatnonzero(inside)
    return BoardView(ids, pixels[ids] + rng.normal(0, noise_px, (len(ids), 2)), 1.2)


def corners_of(
    rig: Rig, board: Board, poses: list[np.ndarray], rng: np.random.Generator, noise_px: float = 0.2
) -> Sightings:
    """What every camera sees of a board held in these places."""
    views: list[dict[int, BoardView]] = [{} for _ in rig]
    for moment, pose in enumerate(poses):
        for camera_idx, camera in enumerate(rig):
            view = seen_corners(camera, board, pose, rng, noise_px)
            if view is not None:
                views[camera_idx][moment] = view
    return Sightings(rig.names, tuple(camera.size for camera in rig), tuple(views))
