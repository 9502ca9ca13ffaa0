"""The people of the accuracy tables, their scans and their hulls: a synthetic BUFF.

Half of them women, half men, drawn from the free body of their sex (the fit gets the neutral one) with detail
of their own that no shape space says, from seeds that nothing was tuned on. A scan is what stereo pairs
around the person would see of body and clothes: points with noise, nothing where fewer than two pairs look,
each labelled skin or cloth by the surface it lies on. A hull is carved from exact silhouettes. All results
are in the body's upright frame (y up), metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from jaxtyping import Bool, Float

from capture.layouts import dome_layout
from capture.rig import Rig
from fit.body.model import BodyModel, load_body
from fit.closest import Container
from fit.frames import scan_in_body_frame
from fit.surface import vertex_normals
from fit.truth import SCORED_REGIONS
from hull.rays import RayScene
from hull.scan import Scan, even_samples
from hull.visual_hull import build_hull
from render.scene import Surface
from render.subject import BARE, CLOTH, Subject, make_subject
from render.synthetic import RECORDING_FROM_BODY, Performance, perform

#: Nothing was tuned on these; odd ones are women.
SEEDS = (9001, 9002, 9003, 9004, 9005, 9006)
#: Those of BUFF: long trousers, and the soccer outfit.
OUTFITS = ("tshirt-trousers", "tshirt-shorts")
MOTIONS = ("tilt-twist", "hips", "shoulders-mill")
#: From nothing to a baggy outfit with its room times VERY_LOOSE.
LOOSENESS = ("none", "tight", "tshirt-trousers", "loose", "very-loose")
VERY_LOOSE = 1.8
SCANS, LABELLED, HULLS_16, HULLS_68 = "scans", "scans-labelled", "hulls-16", "hulls-68"
INPUTS = (SCANS, LABELLED, HULLS_16, HULLS_68)
#: Cameras and width of their square pictures (px); the paper's hulls came from 68 of 4 MP.
RIGS = {HULLS_16: (16, 1024), HULLS_68: (68, 2048)}
VOXEL_M = 0.008

#: Stereo pairs of the scanner; how flat they may look at a surface (cosine); how many must see a point.
N_PAIRS, GRAZING, PAIRS_NEEDED = 22, 0.2, 2
NOISE_M = 0.0005
#: A point looks out from so far above its own surface (garments are layered 1.5 mm apart or more).
ABOVE_M = 0.0004


@lru_cache(maxsize=2)
def _body(name: str) -> BodyModel:
    return load_body(name, show_progress=False)


def dressed_subject(seed: int, outfit: str) -> Subject:
    """The person of a seed: a woman if it is odd. outfit: as of the wardrobe, or "very-loose"."""
    body = _body("free:female" if seed % 2 else "free:male")
    if outfit != "very-loose":
        return make_subject(body, seed, outfit)
    subject = make_subject(body, seed, "loose")
    roomy = []
    for garment in subject.garments:
        if garment.cut.lively == 1.0:  # cloth; hair and shoes stay
            cut = replace(garment.cut, ease_m=VERY_LOOSE * garment.cut.ease_m)
            garment = replace(garment, cut=cut, room_m=VERY_LOOSE * garment.room_m)
        roomy.append(garment)
    return replace(subject, garments=tuple(roomy))


@dataclass(frozen=True)
class Recorded:
    """A person moving: what is seen of every frame, and the truth under it."""

    seed: int
    performance: Performance

    @staticmethod
    def of(seed: int, outfit: str, motion: str, n_frames: int) -> Recorded:
        """Dress the person and let them move."""
        return Recorded(seed, perform(dressed_subject(seed, outfit), motion, n_frames, seed))

    @property
    def subject(self) -> Subject:
        """Who it is."""
        return self.performance.subject

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.performance.vertices)

    @cached_property
    def scored(self) -> Bool[np.ndarray, "v"]:
        """The true vertices that count: torso, arms, legs, neck."""
        return np.isin(self.subject.region, SCORED_REGIONS)

    @property
    def under_cloth(self) -> Bool[np.ndarray, "v"]:
        """Which true vertices cloth covers."""
        return self.subject.covered == CLOTH

    @property
    def bare(self) -> Bool[np.ndarray, "v"]:
        """Which true vertices nothing covers."""
        return self.subject.covered == BARE

    def truth(self, frame_idx: int) -> Float[np.ndarray, "v 3"]:
        """The naked body of a frame."""
        return self.performance.vertices[frame_idx] @ RECORDING_FROM_BODY[:3, :3]

    def scan(self, frame_idx: int, n_points: int) -> Scan:
        """What the scanner gives of a frame, its points labelled."""
        seen = scanned(self.performance.surfaces(frame_idx), n_points, [self.seed, frame_idx, 23])
        return scan_in_body_frame(seen, RECORDING_FROM_BODY)

    def hull(self, frame_idx: int, rig: Rig, n_points: int, seed: int) -> tuple[Scan, Container]:
        """The visual hull of a frame as points and as the closed surface that contains the person."""
        scene = RayScene(*joined(self.performance.surfaces(frame_idx)), n_threads=1)
        images = [np.where(scene.mask(camera), 255, 0).astype(np.uint8) for camera in rig]
        hull = build_hull(rig, images, VOXEL_M)
        scan = scan_in_body_frame(Scan.from_hull(hull, n_points, seed), RECORDING_FROM_BODY)
        return scan, Container.of(hull.vertices @ RECORDING_FROM_BODY[:3, :3], hull.faces)


def rig_of(name: str) -> Rig:
    """The cameras of one kind of hull, on a dome."""
    n_cameras, side_px = RIGS[name]
    return dome_layout(n_cameras, (side_px, side_px))


def joined(surfaces: list[Surface]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V 3) and faces (F 3) of all surfaces as one mesh."""
    first = np.cumsum([0] + [len(s.vertices) for s in surfaces[:-1]])
    faces = [s.faces + start for s, start in zip(surfaces, first, strict=True)]
    return np.concatenate([s.vertices for s in surfaces]), np.concatenate(faces)


def scanned(surfaces: list[Surface], n_points: int, seed: list[int]) -> Scan:
    """Points that enough stereo pairs see of a dressed person (the body first), even in area, with noise."""
    vertices, faces = joined(surfaces)
    scene = RayScene(vertices, faces, n_threads=1)
    of_body = len(surfaces[0].faces)
    normal_of = np.concatenate([vertex_normals(s.vertices, s.faces) for s in surfaces])
    random = np.random.default_rng(seed)
    places = scanner_places()
    more = 4 * n_points
    while True:
        face_idx, barycentric = even_samples(vertices, faces, more, int(random.integers(2**31)))
        corners = faces[face_idx]
        points = np.einsum("nk,nki->ni", barycentric, vertices[corners])
        normals = np.einsum("nk,nki->ni", barycentric, normal_of[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        n_seen = np.zeros(len(points), dtype=int)
        for place in places:
            way = place - points
            facing = np.flatnonzero(
                np.einsum("ni,ni->n", way, normals) > GRAZING * np.linalg.norm(way, axis=1)
            )
            start = points[facing] + ABOVE_M * normals[facing]
            n_seen[facing] += ~scene.hides(start, place - start)
        seen = np.flatnonzero(n_seen >= PAIRS_NEEDED)
        if len(seen) >= n_points:
            break
        more *= 2
    # Samples run along the faces' area, so that every n-th of them is even in area, too.
    seen = seen[np.linspace(0, len(seen) - 1, n_points).round().astype(int)]
    noise = random.normal(0.0, NOISE_M, n_points)
    return Scan(
        points[seen] + noise[:, None] * normals[seen],
        normals[seen],
        None,
        face_idx[seen] < of_body,
        np.ones(n_points),
    )


def scanner_places() -> Float[np.ndarray, "p 3"]:
    """Where the stereo pairs stand, m, z up: two rings and a few above, as around a capture stage."""
    n_ring = (N_PAIRS - 4) // 2
    places = []
    for height, n, radius, begin in ((0.6, n_ring, 2.3, 0.0), (1.7, n_ring, 2.3, 0.5), (2.6, 4, 1.4, 0.25)):
        angle = 2 * np.pi * (np.arange(n) + begin) / n
        places.append(np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(n, height)]))
    return np.concatenate(places)
