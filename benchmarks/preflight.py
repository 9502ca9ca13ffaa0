"""What `bodyhull check` makes of planted faults, and of sound recordings. Prints Markdown tables.

    python -m benchmarks.preflight --trials 20 --seed 1000      # each kind of fault in 20 random recordings
    python -m benchmarks.preflight --only sound mirrored        # some of them
    python -m benchmarks.preflight --offsets 40                 # time offsets from -10 to 10 frames

Each trial is another person, motion, garment, rig (8 to 16 cameras; dome, ring or cage), way of walking,
calibration noise (0 to 1 px), outline noise (0 to 2 px) and file format; the fault is put into a random
camera. A fault counts as named if the verdict holds it with the right kind and cameras and nothing else.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.hull import machine
from bodyhull.checking import Check, check_recording
from capture.calibration_file import camera_number
from capture.camera import Camera
from capture.errors import RecordingError
from capture.layouts import cage_layout, dome_layout, ring_layout
from capture.rig import Rig
from fit.body.model import load_body
from hull.rays import RayScene
from render.motions import MOTIONS
from render.spoil import misplaced_rig, wandering_outline
from render.subject import make_subject
from render.synthetic import perform
from render.wardrobe import OUTFITS

LAYOUTS = {"dome": dome_layout, "ring": ring_layout, "cage": cage_layout}
Masks = list[list["np.ndarray | None"]]


@dataclass
class Scene:
    """A recording in memory: masks[camera][frame], None where there is no file. matrices: instead of the rig,
    where no rig could hold them. sizes: what the calibration says where that is not the pictures' size."""

    rig: Rig
    masks: Masks
    about: str
    as_json: bool
    json_cameras: list[dict] | None = None
    matrices: list[np.ndarray] | None = None

    @property
    def n_frames(self) -> int:
        return len(self.masks[0])

    def copy(self) -> Scene:
        return replace(self, masks=[list(row) for row in self.masks])


def make_scene(seed: int, offsets: bool = False) -> Scene:
    """A random sound recording. `offsets`: no noise beyond a little, the person in view throughout."""
    rng = np.random.default_rng([seed, 77])
    n_cameras = int(rng.choice([8, 8, 8, 10, 12, 16]))
    size = [(512, 512), (400, 600), (640, 480)][rng.integers(3)]
    layout = str(rng.choice(list(LAYOUTS)))
    n_frames = int(rng.integers(30, 46))
    motion, garment = str(rng.choice(list(MOTIONS))), str(rng.choice(list(OUTFITS)))
    rig = LAYOUTS[layout](n_cameras, size)
    subject = make_subject(load_body("free:neutral", show_progress=False), seed, garment)
    performance = perform(subject, motion, n_frames, seed)
    # Where the person is, and whether it walks: from staying in view to leaving several pictures.
    start = rng.uniform(-0.4, 0.4, 2)
    reach = 0.0 if offsets else float(rng.choice([0.0, 0.0, 0.4, 1.0, 1.6]))
    way = rng.normal(size=2)
    way *= reach / np.linalg.norm(way)
    calibration_px, outline_px = float(rng.choice([0, 0.5, 1.0])), float(rng.choice([0, 1.0, 2.0]))
    if offsets:
        calibration_px, outline_px = min(calibration_px, 0.5), min(outline_px, 1.0)
    masks: Masks = [[] for _ in range(n_cameras)]
    for k in range(n_frames):
        shift = np.append(start + way * (k / (n_frames - 1) - 0.5), 0.0)
        vertices, faces, n = [], [], 0
        for surface in performance.surfaces(k):
            vertices.append(surface.vertices + shift)
            faces.append(surface.faces + n)
            n += len(surface.vertices)
        scene = RayScene(np.concatenate(vertices), np.concatenate(faces), n_threads=1)
        for i, camera in enumerate(rig):
            mask = np.where(scene.mask(camera), np.uint8(255), np.uint8(0))
            masks[i].append(wandering_outline(mask, outline_px, rng))
    # Another origin and direction of the world: nothing may depend on them.
    turn = np.eye(4)
    angle = rng.uniform(0, 2 * np.pi)
    turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    turn[:3, 3] = rng.uniform(-1, 1, 3)
    rig = Rig(
        tuple(
            replace(c, camera_from_world=c.camera_from_world @ turn, projection=None)
            for c in misplaced_rig(rig, calibration_px, seed)
        )
    )
    about = (
        f"{n_cameras} {layout} {size[0]}x{size[1]} {motion} {garment} {n_frames} frames, walks {reach:g} m, "
        f"{calibration_px:g} px calibration, {outline_px:g} px outlines"
    )
    return Scene(rig, masks, about, bool(rng.integers(2)))


def write_scene(root: Path, scene: Scene) -> Path:
    """The recording on disk, INRIA's layout; its calibration is setup/ or rig.json (returned)."""
    for i, row in enumerate(scene.masks):
        folder = root / "SilhouettesPictures" / f"cam-{i:03d}"
        if all(mask is None for mask in row):
            continue
        folder.mkdir(parents=True)
        for k, mask in enumerate(row):
            if mask is not None:
                file = folder / f"silh_{k:06d}.png"
                if mask.size:
                    cv2.imwrite(str(file), mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                else:
                    file.write_bytes(b"")
    if scene.as_json:
        import json

        content = scene.rig.to_json()
        if scene.json_cameras is not None:
            content["cameras"] = scene.json_cameras
        (root / "rig.json").write_text(json.dumps(content))
        return root / "rig.json"
    (root / "setup").mkdir()
    for i, camera in enumerate(scene.rig):
        matrix = camera.projection_matrix if scene.matrices is None else scene.matrices[i]
        np.savetxt(root / "setup" / f"cam{i:02d}.txt", matrix, fmt="%.17g")
    return root / "setup"


Planted = tuple[Scene, str, set[int] | None]
"""The wrong scene, the finding's kind, its cameras (None: the whole rig)."""
Plant = Callable[[Scene, np.random.Generator], Planted | None]


def _one(scene: Scene, rng: np.random.Generator, change: Callable[[Camera], Camera]) -> tuple[Scene, int]:
    i = int(rng.integers(len(scene.rig)))
    cameras = [change(c) if k == i else c for k, c in enumerate(scene.rig)]
    return replace(scene, rig=Rig(tuple(cameras))), i


def _all(scene: Scene, change: Callable[[Camera], Camera]) -> Scene:
    return replace(scene, rig=Rig(tuple(change(c) for c in scene.rig)))


def _moved(ratio: float) -> Callable[[Camera], Camera]:
    return lambda camera: camera.with_world_scaled(ratio)


def _inverse(camera: Camera) -> Camera:
    return replace(camera, camera_from_world=np.linalg.inv(camera.camera_from_world))


def units_one(scene: Scene, rng: np.random.Generator) -> Planted:
    made, i = _one(scene, rng, _moved(float(rng.choice([1000, 100, 0.001, 0.01]))))
    return made, "units", {i}


def units_all(scene: Scene, rng: np.random.Generator) -> Planted:
    return _all(scene, _moved(float(rng.choice([1000, 100])))), "units", None


def inverted_one(scene: Scene, rng: np.random.Generator) -> Planted:
    made, i = _one(scene, rng, _inverse)
    return made, "inverted", {i}


def inverted_all(scene: Scene, rng: np.random.Generator) -> Planted:
    return _all(scene, _inverse), "inverted", None


def swapped(scene: Scene, rng: np.random.Generator) -> Planted:
    i, j = (int(k) for k in rng.choice(len(scene.rig), 2, replace=False))
    order = list(range(len(scene.rig)))
    order[i], order[j] = j, i
    names = scene.rig.names
    cameras = tuple(replace(scene.rig[order[k]], name=names[k]) for k in range(len(order)))
    return replace(scene, rig=Rig(cameras)), "swapped", {i, j}


def half_one(scene: Scene, rng: np.random.Generator) -> Planted:
    made, i = _one(scene, rng, lambda c: c.with_pixels_scaled(0.5, 0.5))
    return _with_half_sizes(made, {i}, rng), "picture_size", {i}


def half_all(scene: Scene, rng: np.random.Generator) -> Planted:
    made = _all(scene, lambda c: c.with_pixels_scaled(0.5, 0.5))
    return _with_half_sizes(made, set(range(len(scene.rig))), rng), "picture_size", None


def _with_half_sizes(scene: Scene, those: set[int], rng: np.random.Generator) -> Scene:
    """A rig file says the picture size too: half of the time it is the halved one."""
    if not scene.as_json or rng.integers(2):
        return scene
    cameras = scene.rig.to_json()["cameras"]
    for i in those:
        cameras[i]["size"] = [n // 2 for n in cameras[i]["size"]]
    return replace(scene, json_cameras=cameras)


def unsynchronised(scene: Scene, rng: np.random.Generator) -> Planted:
    i, late = int(rng.integers(len(scene.rig))), int(rng.choice([-8, -6, -5, -4, -3, -2, 2, 3, 4, 5, 6, 8]))
    return late_by(scene, {i: late}, str(rng.choice(["clamped", "missing", "rolled"]))), "unsynchronised", {i}


def late_by(scene: Scene, frames: dict[int, int], way: str = "missing") -> Scene:
    made = scene.copy()
    n = scene.n_frames
    for i, late in frames.items():
        for k in range(n):
            source = k - late
            if way == "clamped":
                source = min(max(source, 0), n - 1)
            elif way == "rolled":
                source %= n
            made.masks[i][k] = scene.masks[i][source] if 0 <= source < n else None
    return made


def mirrored_one(scene: Scene, rng: np.random.Generator) -> Planted:
    i, made = int(rng.integers(len(scene.rig))), scene.copy()
    made.masks[i] = [None if m is None else np.ascontiguousarray(m[:, ::-1]) for m in made.masks[i]]
    return made, "mirrored", {i}


def mirrored_pictures(scene: Scene, rng: np.random.Generator) -> Planted:
    made = scene.copy()
    made.masks = [[None if m is None else np.ascontiguousarray(m[:, ::-1]) for m in r] for r in made.masks]
    return made, "mirrored", None


def mirrored_world(scene: Scene, rng: np.random.Generator) -> Planted:
    signs = np.ones(4)
    signs[rng.integers(3)] = -1
    if not scene.as_json:
        matrices = [c.projection_matrix @ np.diag(signs) for c in scene.rig]
        return replace(scene, matrices=matrices), "mirrored", None
    cameras = scene.rig.to_json()["cameras"]
    for entry in cameras:
        entry["camera_from_world"] = (np.array(entry["camera_from_world"]) @ np.diag(signs)).tolist()
    return replace(scene, json_cameras=cameras), "mirrored", None


def stale(scene: Scene, rng: np.random.Generator) -> Planted:
    i, made = int(rng.integers(len(scene.rig))), scene.copy()
    length = int(rng.integers(5, 16))
    start = int(rng.integers(1, scene.n_frames - length))
    for k in range(start + 1, start + length):
        made.masks[i][k] = made.masks[i][start]
    return made, "stale", {i}


def dead(scene: Scene, rng: np.random.Generator) -> Planted:
    i, made = int(rng.integers(len(scene.rig))), scene.copy()
    shape = np.asarray(scene.masks[i][0]).shape
    way = rng.integers(4)
    nothing = {
        0: np.zeros(shape, np.uint8),
        1: None,
        2: np.zeros((0, 0), np.uint8),
        3: np.zeros(shape, np.uint8),
    }
    first = scene.n_frames // 2 if way == 3 else 0
    for k in range(first, scene.n_frames):
        made.masks[i][k] = nothing[int(way)]
    return made, "dead", {i}


PLANTS: dict[str, Plant] = {
    "sound": lambda scene, rng: (scene, "", set()),
    "units, one camera": units_one,
    "units, all": units_all,
    "inverted, one camera": inverted_one,
    "inverted, all": inverted_all,
    "swapped": swapped,
    "half size, one camera": half_one,
    "half size, all": half_all,
    "unsynchronised": unsynchronised,
    "mirrored, one camera": mirrored_one,
    "mirrored, all pictures": mirrored_pictures,
    "mirrored, world": mirrored_world,
    "stale": stale,
    "dead": dead,
}


def variants(rng: np.random.Generator, every: bool) -> set[str]:
    """One variant of each kind of fault, or every one."""
    if every:
        return set(PLANTS)
    kinds: dict[str, list[str]] = {}
    for name in PLANTS:
        kinds.setdefault(name.split(",")[0], []).append(name)
    return {str(rng.choice(names)) for names in kinds.values()}


def told_by(check: Check) -> list[tuple[str, frozenset[str] | None]]:
    """Kind and camera numbers of every finding; None: the whole rig."""
    return [
        (f.kind.name.lower(), None if f.whole_rig else frozenset(str(camera_number(n)) for n in f.cameras))
        for f in check.findings
    ]


def run_trials(n: int, seed: int, only: list[str], every: bool, verbose: bool) -> None:
    print(machine())
    named: Counter[str] = Counter()
    table: dict[str, Counter[str]] = {name: Counter() for name in PLANTS}
    seconds: list[float] = []
    for trial in range(n):
        scene = make_scene(seed + trial)
        chosen = variants(np.random.default_rng([seed + trial, 5]), every)
        for number, (name, plant) in enumerate(PLANTS.items()):
            if name not in chosen or (only and not any(name.startswith(word) for word in only)):
                continue
            rng = np.random.default_rng([seed + trial, number])
            made, kind, cameras = plant(scene, rng)
            expected = [] if not kind else [(kind, None if cameras is None else frozenset(map(str, cameras)))]
            with tempfile.TemporaryDirectory() as folder:
                root = Path(folder) / "recording"
                root.mkdir()
                where = write_scene(root, made)
                started = time.process_time()
                try:
                    check = check_recording(root, calibration=where)
                    told = told_by(check)
                    lines = [f.sentence() for f in check.findings]
                except RecordingError as error:
                    told, lines = [("error", None)], [str(error)]
                seconds.append(time.process_time() - started)
            right = told == expected
            named[name] += right
            column = ", ".join(sorted({k for k, _ in told})) or "nothing"
            table[name][column if right or column == "nothing" else f"{column} (wrong)"] += 1
            if not right:
                print(f"<!-- {seed + trial} {name}: expected {expected}, told {told}")
                print(f"     {made.about}; {'rig.json' if made.as_json else 'matrices'}")
                print(*(f"     {line}" for line in lines), "-->", sep="\n", flush=True)
        if verbose:
            so_far = ", ".join(f"{name} {named[name]}" for name, told_so in table.items() if told_so)
            print(f"<!-- right of {trial + 1}: {so_far} -->", flush=True)
    print(f"\n{n} recordings from seed {seed}; {np.mean(seconds):.1f} s processor time a check\n")
    kinds: dict[str, list[int]] = {}
    for name, column in table.items():
        count = kinds.setdefault(name.split(",")[0], [0, 0])
        count[0] += named[name]
        count[1] += sum(column.values())
    print(", ".join(f"{kind} {right} of {of}" for kind, (right, of) in kinds.items() if of) + "\n")
    print("| planted | named right | told |")
    print("| --- | --- | --- |")
    for name, column in table.items():
        if column:
            told_list = ", ".join(f"{what}: {count}" for what, count in column.most_common())
            print(f"| {name} | {named[name]} of {sum(column.values())} | {told_list} |")


def run_offsets(n: int, seed: int, verbose: bool) -> None:
    print(machine())
    result: Counter[str] = Counter()
    alarms = 0
    for trial in range(n):
        scene = make_scene(seed + trial, offsets=True)
        rng = np.random.default_rng([seed + trial, 99])
        n_off = int(rng.integers(1, max(len(scene.rig) // 3, 1) + 1))
        those = {int(i): int(rng.integers(-10, 11)) for i in rng.choice(len(scene.rig), n_off, replace=False)}
        with tempfile.TemporaryDirectory() as folder:
            root = Path(folder) / "recording"
            root.mkdir()
            where = write_scene(root, late_by(scene, those))
            check = check_recording(root, calibration=where)
        for i, camera in enumerate(check.cameras):
            truth, found = those.get(i, 0), camera.offset_frames
            error = None if found is None else round(found) - truth
            if i in those:
                result[_judged(error)] += 1
            else:
                alarms += error not in (None, 0)
            if verbose and error not in (None, 0):
                print(f"<!-- {seed + trial} camera {i}: truth {truth}, found {found}; {scene.about} -->")
    total = sum(result.values())
    print(
        f"\n{n} recordings from seed {seed}: of {total} cameras that are off by -10 to 10 frames (one to a "
        f"third of the rig), {dict(result)}; of the others {alarms} are told to be off"
    )


def _judged(error: int | None) -> str:
    if error is None:
        return "cannot be told"
    return "exact" if error == 0 else "off by one" if abs(error) == 1 else "wrong"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--only", nargs="*", default=[], help="faults whose name begins with one of these")
    parser.add_argument("--every", action="store_true", help="every variant of a fault, not one by chance")
    parser.add_argument("--offsets", type=int, default=0, help="trials of time offsets instead")
    parser.add_argument("--keep", type=Path, help="write the recording of --seed with --only there, and stop")
    parser.add_argument("--verbose", action="store_true", help="tell how far it is")
    options = parser.parse_args()
    if options.keep is not None:
        shutil.rmtree(options.keep, ignore_errors=True)
        options.keep.mkdir(parents=True)
        names = list(PLANTS)
        name = next(n for n in names if n.startswith(options.only[0])) if options.only else "sound"
        rng = np.random.default_rng([options.seed, names.index(name)])
        print(write_scene(options.keep, PLANTS[name](make_scene(options.seed), rng)[0]))
    elif options.offsets:
        run_offsets(options.offsets, options.seed, options.verbose)
    else:
        run_trials(options.trials, options.seed, options.only, options.every, options.verbose)


if __name__ == "__main__":
    main()
