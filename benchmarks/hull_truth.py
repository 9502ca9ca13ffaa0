"""How true a hull's surface is: of a figure whose cones are known, and of a clothed person. Markdown tables.

    python -m benchmarks.hull_truth                 # 16 x 1 MP and 68 x 4 MP at 16, 8 and 4 mm
    python -m benchmarks.hull_truth --quick         # 16 x 1 MP at 16 and 8 mm
    python -m benchmarks.hull_truth --person        # the second part alone

Then a clothed synthetic person, whose true surface is known, with 4, 8, 16 (1 MP) and 68 cameras (4 MP), the
hull as it is and with `--refine`; `--quick`: 4 and 8 cameras.

`to the exact hull`: distance of every vertex to the nearest cone of all cameras, taken from the figure itself
and not from its pictures. `to the figure`: what perfect silhouettes leave on top of the subject. A pixel is
measured at the vertex, in its nearest camera.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from benchmarks.hull import FIGURE, figure, machine
from capture.layouts import dome_layout, ring_layout
from capture.rig import Rig
from fit.body import load_body
from hull.quality import contour_distance, silhouette_agreement
from hull.rays import RayScene
from hull.visual_hull import Hull, HullOptions, build_hull
from render.clothed import DressedTruth
from render.subject import make_subject
from render.synthetic import perform

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


PERSON_HEADINGS = (
    "cameras",
    "surface",
    "CPU s",
    "to the person, mean mm",
    "RMS mm",
    "95 % mm",
    "more than 2 mm inside",
    "to the finer hull, RMS mm",
    "IoU worst / mean",
    "outlines apart, worst / mean px",
)


def person() -> tuple[DressedTruth, RayScene]:
    """A woman in a t-shirt and trousers, bent, with spread fingers; the second is for taking pictures."""
    body = load_body("free:female", show_progress=False)
    performance = perform(make_subject(body, seed=5, garment="tshirt-trousers"), "tilt-twist", 6, seed=1)
    surfaces = performance.surfaces(3)
    first = np.cumsum([0] + [len(surface.vertices) for surface in surfaces[:-1]])
    faces = [surface.faces + start for surface, start in zip(surfaces, first, strict=True)]
    scene = RayScene(np.concatenate([s.vertices for s in surfaces]), np.concatenate(faces))
    return DressedTruth(surfaces), scene


def person_rows(n_cameras: int, truth: DressedTruth, scene: RayScene, voxel_m: float) -> Iterator[str]:
    side_px = 2048 if n_cameras > 16 else 1024
    layout = ring_layout if n_cameras == 4 else dome_layout
    rig = layout(n_cameras, (side_px, side_px))
    images = [np.where(scene.mask(camera), 255, 0).astype(np.uint8) for camera in rig]
    # What the silhouettes leave whatever the grid.
    finer = build_hull(rig, images, 0.375 * voxel_m)
    exact = RayScene(finer.vertices, finer.faces)
    for refine in (False, True):
        start = time.process_time()
        hull = build_hull(rig, images, voxel_m, options=HullOptions(refine=refine))
        seconds = time.process_time() - start
        off = 1000 * truth.signed_distance(hull.vertices)
        from_exact = 1000 * exact.signed_distance(hull.vertices)
        agreement = silhouette_agreement(hull.vertices, hull.faces, rig, images)
        contour = contour_distance(hull.vertices, hull.faces, rig, images)
        cells = (
            f"{n_cameras} of {side_px} px",
            "refined" if refine else "hull",
            f"{seconds:.2f}",
            f"{off.mean():.2f}",
            f"{np.sqrt((off**2).mean()):.2f}",
            f"{np.percentile(np.abs(off), 95):.1f}",
            f"{(off < -2).mean() * 100:.1f} %",
            f"{np.sqrt((from_exact**2).mean()):.2f}",
            f"{agreement.min():.4f} / {agreement.mean():.4f}",
            f"{contour.max():.2f} / {contour.mean():.2f}",
        )
        yield f"| {' | '.join(cells)} |"


def person_table(quick: bool) -> None:
    voxel_m = 0.008
    print(f"\nA clothed person at {voxel_m * 1000:g} mm\n")
    print("| " + " | ".join(PERSON_HEADINGS) + " |\n" + "| --- " * len(PERSON_HEADINGS) + "|", flush=True)
    truth, scene = person()
    for n_cameras in (4, 8) if quick else (4, 8, 16, 68):
        for line in person_rows(n_cameras, truth, scene, voxel_m):
            print(line, flush=True)


def figure_tables(quick: bool) -> None:
    for n_cameras, side_px in ((16, 1024),) if quick else ((16, 1024), (68, 2048)):
        rig = dome_layout(n_cameras, (side_px, side_px))
        images = silhouettes(rig)
        print(f"\n{n_cameras} cameras of {side_px} x {side_px}\n")
        print("| " + " | ".join(HEADINGS) + " |\n" + "| --- " * len(HEADINGS) + "|")
        for voxel_m in (0.016, 0.008) if quick else (0.016, 0.008, 0.004):
            print(row(rig, images, voxel_m), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--person", action="store_true")
    options = parser.parse_args()
    print(machine())
    if not options.person:
        figure_tables(options.quick)
    person_table(options.quick)


if __name__ == "__main__":
    main()
