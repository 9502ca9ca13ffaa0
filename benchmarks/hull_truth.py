"""How true a hull's surface is, on a figure whose cones are known exactly. Prints Markdown tables.

    python -m benchmarks.hull_truth                 # 16 x 1 MP and 68 x 4 MP at 16, 8 and 4 mm
    python -m benchmarks.hull_truth --quick         # 16 x 1 MP at 16 and 8 mm

`to the exact hull`: distance of every vertex to the nearest cone of all cameras, taken from the figure itself
and not from its pictures. `to the figure`: what perfect silhouettes leave on top of the subject. A pixel is
measured at the vertex, in its nearest camera.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from jaxtyping import Float

from benchmarks.hull import FIGURE, figure, machine
from capture.layouts import dome_layout
from capture.rig import Rig
from hull.quality import contour_distance, silhouette_agreement
from hull.rays import RayScene
from hull.visual_hull import Hull, build_hull

HEADINGS = (
    "grid",
    "vertices",
    "CPU s",
    "to the exact hull, median",
    "95 %",
    "to the figure, median mm",
    "mean mm",
    "IoU worst / mean",
    "outlines apart, worst / mean px",
    "faces under 5 degrees",
    "slack, median mm",
)


def silhouettes(rig: Rig) -> list[np.ndarray]:
    """What the cameras see of the figure, its capsules cut so fine (a hundredth of a millimetre) as to be
    exact.
    """
    scene = RayScene(*figure(256))
    return [np.where(scene.mask(camera), 255, 0).astype(np.uint8) for camera in rig]


def over_the_figure(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """(N,) metres from the figure's surface, positive outside."""
    nearest = np.full(len(points), np.inf)
    for start, end, radius in FIGURE:
        a, way = np.array(start, dtype=float), np.array(end, dtype=float) - np.array(start)
        share = np.clip((points - a) @ way / (way @ way), 0.0, 1.0)
        nearest = np.minimum(nearest, np.linalg.norm(points - a - share[:, None] * way, axis=1) - radius)
    return nearest


def over_the_cones(points: Float[np.ndarray, "n 3"], rig: Rig) -> Float[np.ndarray, " n"]:
    """(N,) metres outside of the exact hull of the figure (negative: inside): the most that any camera's ray
    through the point passes the figure by."""
    worst = np.full(len(points), -np.inf)
    for camera in rig:
        eye = camera.centre
        ray = points - eye
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        passes = np.full(len(points), np.inf)
        for start, end, radius in FIGURE:
            a, way = np.array(start, dtype=float), np.array(end, dtype=float) - np.array(start)
            passes = np.minimum(passes, _line_to_segment(eye, ray, a, way) - radius)
        worst = np.maximum(worst, passes)
    return worst


def _line_to_segment(
    eye: Float[np.ndarray, " 3"],
    ray: Float[np.ndarray, "n 3"],
    a: Float[np.ndarray, " 3"],
    way: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " n"]:
    """(N,) least distance of the lines eye + t ray (unit) to the segment from a along way."""
    # Across the ray, the segment is a segment in a plane, and the ray a point.
    start, along = a - eye, way
    start = start - (ray @ start)[:, None] * ray
    along = along - (ray @ along)[:, None] * ray
    length = (along**2).sum(axis=1)
    share = np.clip(-(start * along).sum(axis=1) / np.maximum(length, 1e-30), 0.0, 1.0)
    return np.linalg.norm(start + share[:, None] * along, axis=1)


def pixel_m(points: Float[np.ndarray, "n 3"], rig: Rig) -> Float[np.ndarray, " n"]:
    """(N,) the side of a pixel at each point, metres, in the camera that sees it largest."""
    return np.min([np.linalg.norm(points - c.centre, axis=1) / c.intrinsics[0, 0] for c in rig], axis=0)


def smallest_angles_deg(hull: Hull) -> Float[np.ndarray, " f"]:
    """(F,) the smallest angle of each face."""
    a, b, c = (hull.vertices[hull.faces[:, k]] for k in range(3))
    angles = []
    for one, two in ((b - a, c - a), (c - b, a - b), (a - c, b - c)):
        sine = np.linalg.norm(np.cross(one, two), axis=1)
        angles.append(np.arctan2(sine, (one * two).sum(axis=1)))
    return np.rad2deg(np.min(angles, axis=0))


def row(rig: Rig, images: list[np.ndarray], voxel_m: float) -> str:
    start = time.process_time()
    hull = build_hull(rig, images, voxel_m)
    seconds = time.process_time() - start
    pixel = pixel_m(hull.vertices, rig)
    off = np.abs(over_the_cones(hull.vertices, rig))
    surplus = over_the_figure(hull.vertices)
    agreement = silhouette_agreement(hull.vertices, hull.faces, rig, images)
    contour = contour_distance(hull.vertices, hull.faces, rig, images)
    angles = smallest_angles_deg(hull)
    worst = np.percentile(off / pixel, 95)
    cells = (
        f"{voxel_m * 1000:g} mm",
        f"{len(hull.vertices)}",
        f"{seconds:.2f}",
        f"{np.median(off) * 1000:.2f} mm = {np.median(off / pixel):.2f} px",
        f"{worst:.2f} px",
        f"{np.median(np.abs(surplus)) * 1000:.2f}",
        f"{surplus.mean() * 1000:.2f}",
        f"{agreement.min():.4f} / {agreement.mean():.4f}",
        f"{contour.max():.2f} / {contour.mean():.2f}",
        f"{(angles < 5).mean() * 100:.1f} %",
        f"{np.median(hull.slack_m) * 1000:.0f}",
    )
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    print(machine())
    for n_cameras, side_px in ((16, 1024),) if options.quick else ((16, 1024), (68, 2048)):
        rig = dome_layout(n_cameras, (side_px, side_px))
        images = silhouettes(rig)
        print(f"\n{n_cameras} cameras of {side_px} x {side_px}\n")
        print("| " + " | ".join(HEADINGS) + " |\n" + "| --- " * len(HEADINGS) + "|")
        for voxel_m in (0.016, 0.008) if options.quick else (0.016, 0.008, 0.004):
            print(row(rig, images, voxel_m), flush=True)


if __name__ == "__main__":
    main()
