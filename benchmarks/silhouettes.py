"""How good silhouettes are, method by method, and what they cost beside plain OpenCV calls. Markdown tables.

    python -m benchmarks.silhouettes            # all tables; a quarter of an hour on two cores
    python -m benchmarks.silhouettes --speed    # milliseconds a picture of four megapixels
    python -m benchmarks.silhouettes --synthetic --seeds 21 22
    python -m benchmarks.silhouettes --real     # eight hand-checked masks of ../shared/recordings/balancing

Speed: processor time of one thread, the least of the repetitions, the picture already decoded. Synthetic: a
rendered person (and a passer-by) put before backgrounds by `tests.silhouette_scenes`: noise of 3 levels,
shadows, light that drifts by 15 %, a cluttered room, a screen that reflects on legs. Real: every pixel of
hand-drawn masks, as filmed.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from benchmarks.hull import machine
from capture.camera import Camera
from capture.filmed import open_filmed
from capture.layouts import ring_layout
from capture.rig import Rig
from capture.silhouette_maker import MakerOptions, prepare_maker
from tests.silhouette_scenes import KINDS, Seen, Source, iou, write_scene

ROOT = Path(__file__).resolve().parents[1]
BALANCING = ROOT / ".." / "shared" / "recordings" / "balancing"
HAND_MASKS = ROOT / "tests" / "data" / "balancing_masks"
METHODS = ("auto", "plate", "median", "mog2", "knn", "gsoc", "cnt", "chroma")
N_FRAMES, N_CAMERAS, SIZE = 12, 8, (480, 640)
# What the scenes were tuned on is 1 to 9.
SEEDS = (21, 22)


def speed() -> None:
    """One camera of 2048 x 2048 pixels, a person of a ninth of the picture."""
    cv2.setNumThreads(1)
    print("| method | plain OpenCV calls, ms | ours, ms | ratio |\n|---|---:|---:|---:|")
    plain: dict[str, float] = {}
    rows: list[tuple[str, str, float]] = []
    with tempfile.TemporaryDirectory() as name:
        root = Path(name) / "r"
        rig = ring_layout(1, (2048, 2048), camera_height_m=1.5)
        for kind in ("studio", "green"):
            write_scene(root / kind, rig, _ellipse, kind, n_frames=4, n_empty=12, seed=21)
            filmed = open_filmed(root / kind)
            pictures = filmed.frames.read("cam-000", 3)
            picture, empties = pictures[0], list(filmed.scenes["cam-000"].frames())
            assert picture is not None
            methods = ("plate", "median", "mog2", "knn", "gsoc", "cnt") if kind == "studio" else ("chroma",)
            for method in methods:
                maker = prepare_maker(filmed, MakerOptions(method, repair=False))
                ours = least(lambda m=maker, p=pictures: m.make(3, [p]))  # type: ignore[misc]
                same = "plate" if method == "median" else method
                plain[same] = min(plain.get(same, np.inf), least(plain_calls(method, picture, empties)))
                rows.append((method, same, ours))
    for method, same, ours in rows:
        ratio = ours / plain[same]
        print(f"| {method} | {1e3 * plain[same]:.1f} | {1e3 * ours:.1f} | {ratio:.2f} |", flush=True)


def plain_calls(method: str, picture: np.ndarray, empties: list[np.ndarray]) -> Callable[[], object]:
    """What one would write with OpenCV alone."""
    kernel = np.ones((5, 5), np.uint8)
    plate = np.mean(empties, axis=0).astype(np.uint8)
    if method in ("plate", "median"):

        def difference() -> object:
            red, green, blue = cv2.split(cv2.absdiff(picture, plate))
            mask = cv2.threshold(cv2.max(cv2.max(red, green), blue), 20, 255, cv2.THRESH_BINARY)[1]
            return cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel)

        return difference
    if method == "chroma":

        def key() -> object:
            converted = cv2.cvtColor(picture, cv2.COLOR_RGB2YCrCb)
            screen = cv2.inRange(converted, np.array([0, 0, 60.0]), np.array([255, 110.0, 120.0]))
            return cv2.morphologyEx(cv2.bitwise_not(screen), cv2.MORPH_CLOSE, kernel)

        return key
    made = {
        "mog2": cv2.createBackgroundSubtractorMOG2,
        "knn": cv2.createBackgroundSubtractorKNN,
        "gsoc": cv2.bgsegm.createBackgroundSubtractorGSOC,
        "cnt": cv2.bgsegm.createBackgroundSubtractorCNT,
    }[method]()
    for empty in empties:
        made.apply(empty)
    return lambda: made.apply(picture, learningRate=1e-9)


def least(work: Callable[[], object], n: int = 25) -> float:
    """Processor seconds, the least of `n`."""
    best = np.inf
    for _ in range(n):
        started = time.process_time()
        work()
        best = min(best, time.process_time() - started)
    return float(best)


def _ellipse(camera: Camera, frame: int) -> Seen:
    width, height = camera.size
    mask = np.zeros((height, width), np.uint8)
    middle = (width // 2 + 20 * frame, height // 2)
    cv2.ellipse(mask, middle, (width // 12, int(0.4 * height)), 0, 0, 360, 255, -1)
    rgb = np.zeros((height, width, 3), np.uint8)
    rgb[:] = (170, 110, 90)
    return Seen([(rgb, mask)], np.zeros((1, 3)))


def synthetic(seeds: tuple[int, ...], methods: tuple[str, ...]) -> None:
    """IoU over all cameras and every second frame: median and worst picture, with and without repair."""
    print(f"\n{N_CAMERAS} cameras of {SIZE[0]} x {SIZE[1]} px, {N_FRAMES} frames, 12 empty frames a camera\n")
    print(
        "| scene | method | median IoU | worst | with repair: median | worst |\n|---|---|---:|---:|---:|---:|"
    )
    found: dict[tuple[str, str], list[list[float]]] = {}
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            rig = ring_layout(N_CAMERAS, SIZE, camera_height_m=1.5)
            people = rendered(Path(name) / "people", rig, seed)
            for kind in KINDS:
                source = people[1] if kind == "passer-by" else people[0]
                scene = write_scene(Path(name) / kind, rig, source, kind, n_frames=N_FRAMES, seed=seed)
                filmed = open_filmed(scene.root)
                for method in methods:
                    if method == "chroma" and kind != "green":
                        continue
                    for repair in (False, True):
                        maker = prepare_maker(filmed, MakerOptions(method, repair=repair))
                        scores = []
                        for frame in range(0, N_FRAMES, 2):
                            made = maker.make(frame, maker.read(frame))
                            scores += [iou(m, scene.truth[c, frame]) for c, m in enumerate(made.masks)]
                        found.setdefault((kind, method), [[], []])[repair] += scores
    for (kind, method), (plain, mended) in found.items():
        numbers = (np.median(plain), min(plain), np.median(mended), min(mended))
        print(f"| {kind} | {method} | " + " | ".join(f"{value:.3f}" for value in numbers) + " |", flush=True)


def rendered(root: Path, rig: Rig, seed: int) -> tuple[Source, Source]:
    """A clothed person, alone and with a passer-by 1.3 m behind."""
    from dataclasses import replace

    from fit.body.model import load_body
    from render.subject import make_subject
    from render.synthetic import film_performance, perform

    body = load_body("free:neutral", show_progress=False)
    vertices = []
    for idx, (garment, motion) in enumerate((("tshirt-trousers", "tilt-twist"), ("tshirt-shorts", "walk"))):
        performance = perform(make_subject(body, seed + 100 * idx, garment), motion, N_FRAMES, seed)
        # The subject walks past its place, so that a median over time sees what is behind.
        along = np.linspace(-0.7, 0.7, N_FRAMES)[:, None]
        offset = np.concatenate([along, 0 * along, 0 * along], axis=1)
        if idx:
            offset = np.concatenate([-along, 0 * along + 1.3, 0 * along], axis=1)
        performance = replace(performance, vertices=performance.vertices + offset[:, None])
        film_performance(root / str(idx), performance, rig, progress=False)
        vertices.append(performance.vertices)

    def person(idx: int, camera: Camera, frame: int) -> tuple[np.ndarray, np.ndarray]:
        number = rig.names.index(camera.name)
        place = root / str(idx)
        rgb = cv2.imread(str(place / "Pictures" / f"cam-{number:03d}" / f"img_{frame:06d}.png"))
        file = place / "SilhouettesPictures" / f"cam-{number:03d}" / f"silh_{frame:06d}.png"
        mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert rgb is not None and mask is not None
        return rgb[..., ::-1], mask

    def alone(camera: Camera, frame: int) -> Seen:
        return Seen([person(0, camera, frame)], vertices[0][frame][::7])

    def accompanied(camera: Camera, frame: int) -> Seen:
        ordered = [person(1, camera, frame), person(0, camera, frame)]
        # From behind, the passer-by stands in front; the subject is what is left of it.
        depth = [camera.project(v[frame].mean(axis=0)[None])[1][0] for v in vertices]
        if depth[1] < depth[0]:
            subject_rgb, subject_mask = ordered[1]
            ordered[1] = (subject_rgb, np.where(ordered[0][1] > 0, 0, subject_mask).astype(np.uint8))
        return Seen(ordered, vertices[0][frame][::7])

    return alone, accompanied


def real(methods: tuple[str, ...]) -> None:
    """Each hand-checked picture's IoU."""
    if not BALANCING.is_dir():
        print(f"\n{BALANCING}: not here")
        return
    filmed = open_filmed(BALANCING)
    hand = {
        path.stem: cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(HAND_MASKS.glob("*.png"))
    }
    print("\n| method | " + " | ".join(hand) + " | prepare, s | frame, s |")
    print("|---|" + "---:|" * (len(hand) + 2))
    for method in methods:
        started = time.perf_counter()
        maker = prepare_maker(filmed, MakerOptions(method))
        prepared = time.perf_counter() - started
        scores, seconds = {}, []
        for frame in sorted({int(stem.split("_")[1]) for stem in hand}):
            pictures = maker.read(frame)
            started = time.perf_counter()
            made = maker.make(frame, pictures)
            seconds.append(time.perf_counter() - started)
            for idx, camera in enumerate(filmed.cameras):
                stem = f"{camera}_{frame:06d}"
                if stem in hand:
                    mask = made.masks[idx]
                    person = np.zeros_like(hand[stem]) if mask is None else mask == 255
                    a, b = person > 0, hand[stem] > 0
                    scores[stem] = (a & b).sum() / (a | b).sum()
        numbers = " | ".join(f"{scores[stem]:.4f}" for stem in hand)
        print(f"| {method} | {numbers} | {prepared:.0f} | {np.median(seconds):.2f} |", flush=True)


def main() -> None:
    """All tables, or those asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("speed", "synthetic", "real"):
        parser.add_argument(f"--{name}", action="store_true")
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    parser.add_argument("--methods", nargs="+", default=None, choices=METHODS)
    chosen = parser.parse_args()
    everything = not (chosen.speed or chosen.synthetic or chosen.real)
    print(f"{machine()}, opencv {cv2.__version__}\n")
    if chosen.speed or everything:
        speed()
    if chosen.synthetic or everything:
        synthetic(tuple(chosen.seeds), tuple(chosen.methods or METHODS))
    if chosen.real or everything:
        real(tuple(chosen.methods or ("auto", "plate")))


if __name__ == "__main__":
    main()
