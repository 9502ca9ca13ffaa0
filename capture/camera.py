"""A camera: pinhole plus OpenCV lens distortion, and the project's pixel convention.

Axes as in OpenCV: x right, y down, z forward. Pixel (0, 0) is the *centre* of the first pixel, so a picture
of width w covers u from -0.5 to w - 0.5. Readers of formats that count otherwise (`capture.formats`) convert
on the way in.

Lens model: the rational-polynomial model of OpenCV's calibration module (Brown-Conrady radial and tangential
terms; k4 to k6 in the denominator), in OpenCV's order k1 k2 p1 p2 [k3 [k4 k5 k6]].
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Shaped

_N_DISTORTION = (0, 4, 5, 8)


@dataclass(frozen=True, eq=False)
class Camera:
    """One calibrated camera.

    Fields
    ------
    name : label, also the name of the camera's folder or video.
    size : (width, height), px.
    intrinsics : (3 3), px; may have a skew at [0, 1].
    camera_from_world : (4 4), a rotation and a translation in world units (metres once a recording is open).
    distortion : OpenCV order, length 0 (a pinhole), 4, 5 or 8.
    projection : (3 4) or None. For pinholes that came as a matrix: that matrix up to scale, scaled so that
    its third
        row gives the depth. It is what `project` uses, so nothing is lost in splitting it into the fields
        above.

    Raises ValueError for values that cannot be a camera.
    """

    name: str
    size: tuple[int, int]
    intrinsics: Float[np.ndarray, "3 3"]
    camera_from_world: Float[np.ndarray, "4 4"]
    distortion: Float[np.ndarray, " d"]
    projection: Float[np.ndarray, "3 4"] | None = None

    def __post_init__(self) -> None:
        for field, shape in (
            ("intrinsics", (3, 3)),
            ("camera_from_world", (4, 4)),
            ("distortion", None),
            ("projection", (3, 4)),
        ):
            value = getattr(self, field)
            if value is None:
                continue
            array = np.array(value, dtype=np.float64)
            if shape is not None and array.shape != shape:
                raise ValueError(f"camera {self.name}: {field} has shape {array.shape}, expected {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"camera {self.name}: {field} holds a value that is not a finite number")
            array.setflags(write=False)
            object.__setattr__(self, field, array)
        object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))
        if min(self.size) < 1:
            raise ValueError(f"camera {self.name}: picture size {self.size} px is not positive")
        if self.distortion.shape not in {(n,) for n in _N_DISTORTION}:
            raise ValueError(
                f"camera {self.name}: {self.distortion.size} distortion values; OpenCV has 0, 4, 5 or 8"
            )
        if self.projection is not None and not self.is_pinhole:
            raise ValueError(
                f"camera {self.name}: a projection matrix and lens distortion exclude each other"
            )
        rotation = self.camera_from_world[:3, :3]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-5 or np.linalg.det(rotation) < 0:
            raise ValueError(f"camera {self.name}: the 3x3 part of camera_from_world is not a rotation")
        if self.intrinsics[0, 0] <= 0 or self.intrinsics[1, 1] <= 0:
            raise ValueError(f"camera {self.name}: focal lengths must be positive")

    # -- identity: two cameras are equal when every number is ----------------------------------------------

    def _key(self) -> tuple[object, ...]:
        arrays = (self.intrinsics, self.camera_from_world, self.distortion, self.projection)
        return (self.name, self.size, *(None if a is None else a.tobytes() for a in arrays))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Camera) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    # -- geometry ------------------------------------------------------------------------------------------

    @property
    def is_pinhole(self) -> bool:
        """True where the lens adds nothing: no distortion values at all."""
        return self.distortion.size == 0

    @property
    def projection_matrix(self) -> Float[np.ndarray, "3 4"]:
        """(3 4): px = P @ [X; 1] up to the third value, which is the depth. Without the lens distortion, if
        any."""
        if self.projection is not None:
            return self.projection
        return self.intrinsics @ self.camera_from_world[:3]

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        """(3,): where the camera stands, world."""
        matrix = self.projection_matrix
        return -np.linalg.solve(matrix[:, :3], matrix[:, 3])

    @property
    def forward(self) -> Float[np.ndarray, " 3"]:
        """(3,): unit viewing direction, world."""
        return self.camera_from_world[2, :3].copy()

    @property
    def up(self) -> Float[np.ndarray, " 3"]:
        """(3,): unit direction that points to the top of the picture, world."""
        return -self.camera_from_world[1, :3]

    def project(
        self, points_world: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """World points (N 3) -> pixels (N 2) and depths (N,), through the lens if it distorts.

        Depth is along the viewing axis, in world units. A point with depth <= 0 is behind the camera: its
        pixel means nothing. A point so far off the axis that the lens model folds back gets NaN pixels.
        """
        matrix = self.projection_matrix
        homogeneous = points_world @ matrix[:, :3].T + matrix[:, 3]
        depth = homogeneous[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = homogeneous[:, :2] / depth[:, None]
        if not self.is_pinhole:
            pixels = self.distort(pixels)
        return pixels, depth

    def unproject(
        self, pixels: Float[np.ndarray, "n 2"], depth: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n 3"]:
        """Pixels (N 2) at depths (N,) -> world points (N 3): the inverse of `project`."""
        matrix = self.projection_matrix
        homogeneous = np.column_stack([self.undistort(pixels), np.ones(len(pixels))]) * depth[:, None]
        return np.linalg.solve(matrix[:, :3], (homogeneous - matrix[:, 3]).T).T

    def rays(
        self, pixels: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "n 3"]]:
        """Pixels (N 2) -> the camera's centre (3,) and unit directions (N 3) of the rays through them,
        world."""
        matrix = self.projection_matrix
        homogeneous = np.column_stack([self.undistort(pixels), np.ones(len(pixels))])
        directions = np.linalg.solve(matrix[:, :3], homogeneous.T).T
        return self.centre, directions / np.linalg.norm(directions, axis=1, keepdims=True)

    # -- lens ----------------------------------------------------------------------------------------------

    def distort(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of `pinhole()` (N 2) -> pixels of this camera (N 2); NaN beyond where the lens model folds
        back."""
        if self.is_pinhole:
            return pixels.copy()
        flat = _plane_from_pixels(self.intrinsics, pixels)
        return _pixels_from_plane(self.intrinsics, _distort_plane(flat, self.distortion))

    def undistort(self, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Pixels of this camera (N 2) -> pixels of `pinhole()` (N 2), iterated to about 1e-9 px."""
        if self.is_pinhole or len(pixels) == 0:
            return pixels.copy()
        bent = _plane_from_pixels(self.intrinsics, pixels)
        criteria = (cv2.TERM_CRITERIA_MAX_ITER | cv2.TERM_CRITERIA_EPS, 200, 1e-13)
        # The identity as camera matrix: OpenCV's own handling of the intrinsics would drop a skew.
        flat = cv2.undistortPoints(
            np.ascontiguousarray(bent)[:, None], np.eye(3), np.array(self.distortion), criteria=criteria
        )
        return _pixels_from_plane(self.intrinsics, flat.reshape(-1, 2))

    def pinhole(self) -> Camera:
        """The same camera with an ideal lens: what undistorted pictures were seen by."""
        return self if self.is_pinhole else replace(self, distortion=np.zeros(0))

    def undistort_image(
        self, image: Shaped[np.ndarray, "h w *channels"], *, outside: int = 0
    ) -> Shaped[np.ndarray, "h w *channels"]:
        """The picture as `pinhole()` sees it (same size, same intrinsics), bilinear; `outside` where it saw
        nothing.

        A pinhole's picture comes back as it is, not copied. For silhouettes use
        `capture.silhouette_files.undistort_silhouette`, which keeps "saw nothing" apart from "saw
        background".
        """
        if image.shape[1::-1] != self.size:
            raise ValueError(
                f"camera {self.name}: picture of {image.shape[1::-1]} px, calibrated for {self.size}"
            )
        if self.is_pinhole:
            return image
        columns, rows = _undistortion_maps(self)
        return cv2.remap(
            image,
            columns,
            rows,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(float(outside),) * 4,
        )

    def with_pixels_scaled(self, across: float, down: float, size: tuple[int, int] | None = None) -> Camera:
        """The same camera with `across` times as many columns and `down` times as many rows in its pictures,
        of which `size` (width, height) says how many there are (as before if None)."""
        # Pixels are counted from their centres, so it is the pictures' corner at -0.5 that stays.
        change = np.array([[across, 0, 0.5 * across - 0.5], [0, down, 0.5 * down - 0.5], [0, 0, 1.0]])
        projection = None if self.projection is None else change @ self.projection
        return replace(
            self, size=size or self.size, intrinsics=change @ self.intrinsics, projection=projection
        )

    def with_world_scaled(self, factor: float) -> Camera:
        """The same camera in a world whose coordinates are multiplied by `factor` (millimetres to metres:
        1e-3)."""
        pose = self.camera_from_world.copy()
        pose[:3, 3] *= factor
        projection = self.projection
        if projection is not None:
            # Scaling the last column alone keeps the pixels and turns the third value into the new depth.
            projection = projection.copy()
            projection[:, 3] *= factor
        return replace(self, camera_from_world=pose, projection=projection)


def _plane_from_pixels(
    intrinsics: Float[np.ndarray, "3 3"], pixels: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    y = (pixels[:, 1] - intrinsics[1, 2]) / intrinsics[1, 1]
    x = (pixels[:, 0] - intrinsics[0, 2] - intrinsics[0, 1] * y) / intrinsics[0, 0]
    return np.column_stack([x, y])


def _pixels_from_plane(
    intrinsics: Float[np.ndarray, "3 3"], plane: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    return plane @ intrinsics[:2, :2].T + intrinsics[:2, 2]


def _distort_plane(
    plane: Float[np.ndarray, "n 2"], distortion: Float[np.ndarray, " d"]
) -> Float[np.ndarray, "n 2"]:
    """OpenCV's lens model on the plane z = 1 (N 2 -> N 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(distortion, (0, 8 - distortion.size))
    x, y = plane[:, 0], plane[:, 1]
    r2 = x * x + y * y
    r2 = np.where(r2 < _fold_radius(distortion.tobytes()) ** 2, r2, np.nan)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.column_stack([bent_x, bent_y])


@lru_cache(maxsize=256)
def _fold_radius(distortion_bytes: bytes) -> float:
    """Radius on the plane z = 1 from which the radial polynomial stops growing: beyond, it maps back into
    the picture.

    Searched to 60 degrees off the axis twice over (radius 3.5); infinite where it grows all the way.
    """
    distortion = np.frombuffer(distortion_bytes)
    k1, k2, _, _, k3, k4, k5, k6 = np.pad(distortion, (0, 8 - distortion.size))
    radius = np.linspace(0, 3.5, 7001)
    r2 = radius**2
    bent = radius * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    falling = np.flatnonzero(np.diff(bent) <= 0)
    return float(radius[falling[0]]) if falling.size else float("inf")


@lru_cache(maxsize=16)
def _undistortion_maps(camera: Camera) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """For every pixel of `pinhole()`, column and row (h w each) of the pixel it comes from; -1e6: from
    nowhere.

    Cached for the cameras in use: maps cost 8 bytes a pixel and are the same in every frame.
    """
    width, height = camera.size
    source = np.empty((2, height, width), np.float32)
    columns = np.arange(width, dtype=np.float64)
    # In strips: the float64 intermediates of a whole 4 MP picture would take 300 MB.
    for row in range(0, height, 256):
        rows = np.arange(row, min(row + 256, height), dtype=np.float64)
        pixels = np.stack(np.meshgrid(columns, rows), axis=-1)
        bent = camera.distort(pixels.reshape(-1, 2)).reshape(pixels.shape)
        source[:, row : row + len(rows)] = np.moveaxis(bent, -1, 0)
    np.nan_to_num(source, copy=False, nan=-1e6)
    source.setflags(write=False)
    return source[0], source[1]
