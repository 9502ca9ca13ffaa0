"""A synthetic recording: a clothed person with a known body, moving, filmed by a synthetic rig, in the INRIA
layout.

    OUT/setup/camNN.txt                               3x4 projection matrices, pixels from metres, all digits
    OUT/SilhouettesPictures/cam-NNN/silh_NNNNNN.png   255 person, 0 background, sampled at the pixels' centres
    OUT/Pictures/cam-NNN/img_NNNNNN.png               lit colour pictures before a plain studio
    OUT/truth/truth.npz                               the naked body of every frame

World: metres, z up, floor at z = 0; the person faces -y in the zero pose.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from tqdm import tqdm

from capture.camera import Camera
from capture.layouts import cage_layout, dome_layout, ring_layout
from capture.rig import Rig
from fit.body import BodyModel
from fit.body.skeleton import JOINT

from .light import bake
from .motions import joint_positions, make_motion, stance_travel
from .scene import Renderer, Surface, studio_lights
from .subject import Subject, make_subject

LAYOUTS: dict[str, Callable[[int, tuple[int, int]], Rig]] = {
    "dome": dome_layout,
    "ring": ring_layout,
    "cage": cage_layout,
}
"""Every camera layout by its name on the command line."""

RECORDING_FROM_BODY = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])
"""World (z up) from the body's upright frame (y up, z front): a quarter turn about x."""
UP = np.array([0.0, 0.0, 1.0])
FRAME_RADIANS = 0.5
"""What one frame advances the drift of the cloth by (rad)."""
OWN_FOLDERS = ("setup", "SilhouettesPictures", "Pictures", "truth")

TRUTH_JOINTS = {
    "pelvis": "pelvis", "spine": "spine2", "neck": "neck", "head": "head",
    "l_shoulder": "left_shoulder", "l_elbow": "left_elbow", "l_wrist": "left_wrist",
    "r_shoulder": "right_shoulder", "r_elbow": "right_elbow", "r_wrist": "right_wrist",
    "l_hip": "left_hip", "l_knee": "left_knee", "l_ankle": "left_ankle",
    "r_hip": "right_hip", "r_knee": "right_knee", "r_ankle": "right_ankle",
}  # fmt: skip
"""The truth file's joints by our own."""


Spoil = Callable[[int, int, np.ndarray], np.ndarray]
"""(camera, frame, silhouette) -> the silhouette as a worse segmentation would give it."""


class SyntheticError(ValueError):
    """A film that cannot be made: what was asked for and what there is."""


@dataclass(frozen=True)
class Performance:
    """A subject in motion, in the world (m, z up). pose, translation: the subject's own frame; vertices: the
    world.
    """

    subject: Subject
    pose: Float[np.ndarray, "t j 3"]
    translation: Float[np.ndarray, "t 3"]
    vertices: Float[np.ndarray, "t v 3"]

    def surfaces(self, frame_idx: int) -> list[Surface]:
        """Body and clothes of one frame, world."""
        here = self.vertices[frame_idx]
        before = self.vertices[max(frame_idx - 1, 0)]
        after = self.vertices[min(frame_idx + 1, len(self.vertices) - 1)]
        n_steps = max(min(frame_idx + 1, len(self.vertices) - 1) - max(frame_idx - 1, 0), 1)
        return self.subject.dressed(here, (after - before) / n_steps, UP, FRAME_RADIANS * frame_idx)


def perform(subject: Subject, motion: str, n_frames: int, seed: int = 0) -> Performance:
    """The subject carrying out a motion with its lowest point (sole or foot) on the floor in every frame."""
    moves = make_motion(motion, n_frames, seed)
    travel = stance_travel(moves, subject.joints)
    turn = RECORDING_FROM_BODY[:3, :3]
    vertices = np.empty((n_frames, len(subject.template), 3))
    for frame_idx in range(n_frames):
        vertices[frame_idx] = subject.posed(moves.pose[frame_idx], travel[frame_idx]) @ turn.T
    translation = travel.copy()
    for frame_idx in range(n_frames):
        surfaces = subject.dressed(vertices[frame_idx], np.zeros_like(subject.template), UP, 0.0)
        lowest = min(surface.vertices[:, 2].min() for surface in surfaces)
        vertices[frame_idx, :, 2] -= lowest
        translation[frame_idx, 1] -= lowest
    return Performance(subject, moves.pose, translation, vertices)


def film(
    out: Path | str,
    *,
    body: BodyModel,
    n_cameras: int = 16,
    size: tuple[int, int] = (1024, 1024),
    layout: str = "dome",
    n_frames: int = 12,
    motion: str = "tilt-twist",
    garment: str = "tshirt-trousers",
    seed: int = 0,
    sequence: str = "",
    pictures: bool = True,
    overwrite: bool = False,
    progress: bool = True,
) -> Path:
    """Film a person drawn from `seed` and write the recording; returns the truth file's path.

    layout: a name of LAYOUTS; motion: of `motions.MOTIONS`; garment: of `wardrobe.OUTFITS`. sequence: name of
    a folder between OUT and the pictures, and of the truth file; none, and "truth", where empty.
    SyntheticError for unknown names and for a folder that holds a recording already (unless `overwrite`: then
    the old one is removed).
    """
    out = Path(out)
    if layout not in LAYOUTS:
        raise SyntheticError(f"no camera layout is called {layout!r}; there are: {', '.join(LAYOUTS)}")
    if n_cameras < 1 or min(size) < 8:
        raise SyntheticError(
            f"{n_cameras} cameras of {size[0]} x {size[1]} pixels: at least 1 camera and 8 pixels are needed"
        )
    rig = LAYOUTS[layout](n_cameras, size)
    performance = perform(make_subject(body, seed, garment), motion, n_frames, seed)
    _make_room(out, overwrite)
    write_setup(out / "setup", rig)
    place = out / sequence if sequence else out
    film_performance(place, performance, rig, pictures=pictures, progress=progress)
    settings = {
        "seed": seed, "motion": motion, "garment": garment, "layout": layout, "cameras": n_cameras,
        "size": list(size), "frames": n_frames,
    }  # fmt: skip
    truth = out / "truth" / f"{sequence or 'truth'}.npz"
    write_truth(truth, performance, settings)
    return truth


def film_performance(
    place: Path,
    performance: Performance,
    rig: Rig,
    *,
    pictures: bool = True,
    spoil: Spoil | None = None,
    progress: bool = True,
) -> None:
    """Draw every frame with every camera and write silhouettes, and pictures if wanted, below `place`.

    spoil: what becomes of each silhouette (camera, frame, silhouette) before it is written.
    """
    renderer = Renderer(*rig[0].size)
    lights = studio_lights(UP)
    backgrounds = [_studio(camera) for camera in rig] if pictures else []
    for camera_idx in range(len(rig)):
        for folder in ("SilhouettesPictures", "Pictures")[: 1 + pictures]:
            (place / folder / f"cam-{camera_idx:03d}").mkdir(parents=True, exist_ok=True)
    with tqdm(
        total=len(performance.vertices) * len(rig),
        desc="filming",
        unit="picture",
        disable=not progress,
        leave=False,
    ) as bar:
        for frame_idx in range(len(performance.vertices)):
            surfaces = performance.surfaces(frame_idx)
            stage = renderer.stage(bake(surfaces, lights) if pictures else surfaces)
            for camera_idx, camera in enumerate(rig):
                label = f"cam-{camera_idx:03d}"
                if pictures:
                    seen = stage.colour(camera, ())
                    mask = seen.mask
                    picture = blend(seen.colour, seen.coverage, backgrounds[camera_idx])
                    _write_png(place / "Pictures" / label / f"img_{frame_idx:06d}.png", picture[:, :, ::-1])
                else:
                    mask = stage.silhouette(camera)[0]
                silhouette = np.where(mask, np.uint8(255), np.uint8(0))
                if spoil is not None:
                    silhouette = spoil(camera_idx, frame_idx, silhouette)
                _write_png(place / "SilhouettesPictures" / label / f"silh_{frame_idx:06d}.png", silhouette)
                bar.update()


def blend(
    colour: UInt8[np.ndarray, "h w 3"], coverage: UInt8[np.ndarray, "h w"], behind: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """An anti-aliased drawing on black put before a background."""
    out = behind.copy()
    rows, columns = np.nonzero(coverage)
    share = 255 - coverage[rows, columns].astype(np.uint16)[:, None]
    under = behind[rows, columns].astype(np.uint16) * share // 255
    out[rows, columns] = np.minimum(colour[rows, columns] + under, 255).astype(np.uint8)
    return out


def write_setup(folder: Path, rig: Rig) -> None:
    """One text file a camera: its 3x4 matrix (pixels from metres) with as many digits as a double has."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera_idx, camera in enumerate(rig):
        rows = (" ".join(f"{value:.17g}" for value in row) for row in camera.projection_matrix)
        (folder / f"cam{camera_idx:02d}.txt").write_text("\n".join(rows) + "\n")


def write_truth(path: Path, performance: Performance, settings: dict[str, object]) -> None:
    """The naked body of every frame, in the shape of the `people` truth files and with what made it."""
    subject = performance.subject
    centred = joint_positions(performance.pose, subject.joints) + performance.translation[:, None]
    world = centred @ RECORDING_FROM_BODY[:3, :3].T
    joints = [
        {name: np.round(frame[JOINT[ours]], 5).tolist() for name, ours in TRUTH_JOINTS.items()}
        for frame in world
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial.npz")
    np.savez_compressed(
        partial,
        vertices=performance.vertices.astype(np.float32),
        faces=subject.body.faces.astype(np.int32),
        region=subject.region,
        outer=np.ones(len(subject.template), bool),
        covered=subject.covered,
        joints=json.dumps(joints),
        template=subject.template,
        pose=performance.pose,
        translation=performance.translation,
        betas=subject.betas,
        body=subject.body.name,
        body_hash=subject.body.content_hash,
        recording_from_body=RECORDING_FROM_BODY,
        frame_ids=np.arange(len(performance.vertices)),
        settings=json.dumps(settings),
    )
    partial.replace(path)


def _make_room(out: Path, overwrite: bool) -> None:
    """An empty place for the recording: cameras or frames left over from another one would be read as part of
    it.
    """
    there = [name for name in OWN_FOLDERS if (out / name).exists()]
    if there and not overwrite:
        raise SyntheticError(
            f"{out} holds a recording already ({', '.join(there)}): choose another folder or pass --overwrite"
        )
    for name in there:
        shutil.rmtree(out / name)
    out.mkdir(parents=True, exist_ok=True)


def _write_png(path: Path, image: np.ndarray) -> None:
    """PNG, lightly compressed (a film is thousands of them), whole or not at all."""
    done, data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    partial = path.with_name(f".{path.name}.partial")
    partial.write_bytes(data.tobytes())
    partial.replace(path)


def _studio(camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """An empty studio as the camera sees it: a grey floor with a faint metre grid, fading into the walls."""
    width, height = camera.size
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).reshape(-1, 2).astype(float)
    eye, directions = camera.rays(pixels)
    down = directions @ UP
    reach = np.where(down < -1e-3, -(eye @ UP) / np.minimum(down, -1e-3), np.inf)
    wall = 118.0 + 40.0 * np.clip(down, -0.4, 0.8)
    on_floor = np.isfinite(reach)
    floor = eye[:2] + np.where(on_floor, reach, 0.0)[:, None] * directions[:, :2]
    radius = np.linalg.norm(floor, axis=1)
    line = np.abs((floor + 0.5) % 1.0 - 0.5).min(1)
    shade = 168.0 - 9.0 * np.clip(1.0 - line / 0.012, 0.0, 1.0) * (radius < 3.5)
    fade = np.where(on_floor, np.clip((radius - 2.5) / 3.0, 0.0, 1.0), 1.0)
    grey = (shade * (1 - fade) + wall * fade).reshape(height, width, 1)
    return np.clip(grey * np.array([0.98, 1.0, 1.02]), 0, 255).astype(np.uint8)
