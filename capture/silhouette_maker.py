"""Silhouettes of all cameras of a recording, a frame at a time, by one of several methods.

auto : colours and minimum cut (`capture.segmentation`) before a background that the film itself corrects
    (`capture.background`); before a screen of one colour, `chroma`.
plate, median : difference to an empty picture's mean and spread, or to the median over time.
mog2, knn, gsoc, cnt : OpenCV's background models, trained and held still.
chroma : the screen's colour.

The plain methods first look coarsely at all pictures, choose the subject, and then look finely in its box
alone. All masks are as filmed (lens distortion included).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from capture.background import Backgrounds, build_backgrounds
from capture.chroma_key import KeyDifference, find_key, key_of_colour
from capture.colour_difference import CLEAR_LEVELS, departure, shrunk
from capture.difference import Difference, Look, full_size
from capture.emptied_film import emptied
from capture.errors import RecordingError
from capture.filmed import Filmed
from capture.mask_border import refined
from capture.mask_repair import MaskRepair
from capture.mixture_difference import train
from capture.plate_difference import PlateDifference, PlateLook, light_gains, light_table
from capture.plates import Plate, learn_plate, median_plate
from capture.segmentation import segment
from capture.silhouettes import sentence
from capture.subject_choice import SubjectChoice, largest_parts

METHODS = ("auto", "plate", "median", "mog2", "knn", "gsoc", "cnt", "chroma")
REFINEMENTS = ("auto", "guided", "grabcut", "none")
_MIXTURES = ("mog2", "knn", "gsoc", "cnt")
_N_SAMPLES = 20
_SHORTEST_SPAN = 100  # frames that the samples cover at least, where there are so many
_N_PATH, _N_TOLERANCE = 10, 3  # samples for the subject's path, and for what the calibration allows
_LIGHT_CHANGED = 0.6  # of the picture differs: no subject does that
_LEAST_COARSE = 30  # px of the coarse look; less is no person
_DRIFT_NOTICED = 0.03
_MANY_EMPTY = 10  # empty frames that need no correction by the film
_OUTLINE_SHARE = 1 / 40  # without a hull: how far around what differs the subject may reach

Picture = UInt8[np.ndarray, "_h _w 3"]
Mask = UInt8[np.ndarray, "_h _w"]
Report = Callable[[str], None]


@dataclass(frozen=True)
class MakerOptions:
    """method : of METHODS; refine : of REFINEMENTS; repair : let the other cameras mend each mask; key : the
    screen's colour, RGB, where it is not to be found out."""

    method: str = "auto"
    refine: str = "auto"
    repair: bool = True
    key: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class MadeFrame:
    """One frame's masks as filmed, one a camera (255 person, 0 background, 128 unknown; None: no evidence);
    problems : a sentence each; mended : camera -> what the other cameras changed."""

    frame_id: int
    masks: tuple[Mask | None, ...]
    problems: tuple[str, ...]
    mended: dict[str, str]


@dataclass(frozen=True)
class SilhouetteMaker:
    """Everything learnt, ready for any frame in any order.

    differences : one a camera; not asked where there is `cut`, the backgrounds for the minimum cut.
    backgrounds : one empty picture a camera. subject : who is meant, where cameras can tell. methods : the
    one of each camera.
    """

    filmed: Filmed
    options: MakerOptions
    differences: tuple[Difference, ...]
    cut: Backgrounds | None
    backgrounds: tuple[Picture, ...]
    subject: SubjectChoice | None
    repair: MaskRepair | None
    methods: tuple[str, ...]

    def make(self, frame_id: int, pictures: Sequence[tuple[Picture | None, str]]) -> MadeFrame:
        """One frame's masks. pictures : one a camera, (h w 3) RGB as filmed, with "", or None with a phrase
        that says why there is none."""
        shown = [picture for picture, _ in pictures]
        phrases = [problem for _, problem in pictures]
        by = self._by_cut if self.cut is not None else self._by_difference
        masks, found = by(frame_id, shown)
        mended: dict[str, str] = {}
        if self.repair is not None:
            masks, said = self.repair.repaired(masks, shown, self.backgrounds)
            mended = {camera: what for camera, what in zip(self.filmed.cameras, said, strict=True) if what}
        problems = []
        for camera_idx, camera in enumerate(self.filmed.cameras):
            phrase = phrases[camera_idx] or found[camera_idx]
            if not phrase and _is_empty(masks[camera_idx]):
                phrase = "silhouette is empty (nothing differs from the background" + (
                    " where cameras agree)" if self.filmed.rig is not None else ")"
                )
            if phrase:
                masks[camera_idx] = None
                path = self.filmed.frames.path(camera, frame_id)
                problems.append(sentence(camera, frame_id, phrase, path))
        return MadeFrame(frame_id, tuple(masks), tuple(problems), mended)

    def read(self, frame_id: int) -> list[tuple[Picture | None, str]]:
        """The frame's pictures, as `make` takes them."""
        return [self.filmed.frames.read(camera, frame_id) for camera in self.filmed.cameras]

    def _by_cut(self, frame_id: int, pictures: list[Picture | None]) -> tuple[list[Mask | None], list[str]]:
        assert self.cut is not None
        found = ["" for _ in pictures]
        even: list[Picture | None] = []
        for camera_idx, picture in enumerate(pictures):
            if picture is None:
                even.append(None)
                continue
            small, behind = shrunk(picture, self.cut.scale), self.cut.small[camera_idx]
            table = light_table(light_gains(small, behind), _DRIFT_NOTICED)
            if table is not None:
                picture, small = cv2.LUT(picture, table), cv2.LUT(small, table)
            changed = float((departure(small, behind) > CLEAR_LEVELS).mean())
            if changed > _LIGHT_CHANGED:
                found[camera_idx] = _light_phrase(changed)
            even.append(None if found[camera_idx] else picture)
        outlines = self.cut.outlines(even)
        masks: list[Mask | None] = []
        for camera_idx, picture in enumerate(even):
            outline = outlines[camera_idx]
            if picture is None or outline is None:
                masks.append(None)
                continue
            look = self.differences[camera_idx].look(picture)
            outline = _without_shadow(outline, look, self.differences[camera_idx].step)
            mask = segment(picture, self.cut.pictures[camera_idx], outline, self.cut.trusted[camera_idx])
            masks.append(self._refined(mask, picture))
        return masks, found

    def _by_difference(
        self, frame_id: int, pictures: list[Picture | None]
    ) -> tuple[list[Mask | None], list[str]]:
        found = ["" for _ in pictures]
        looks: list[Look | None] = []
        for camera_idx, picture in enumerate(pictures):
            look = None if picture is None else self.differences[camera_idx].look(picture)
            if look is not None and look.changed > _LIGHT_CHANGED:
                found[camera_idx], look = _light_phrase(look.changed), None
            looks.append(look)
        coarse = [None if look is None else look.coarse for look in looks]
        if self.subject is not None:
            kept = self.subject.kept(frame_id, coarse)
        else:
            kept = [None if mask is None else largest_parts(mask) for mask in coarse]
        masks: list[Mask | None] = []
        for camera_idx, look in enumerate(looks):
            picture, region = pictures[camera_idx], kept[camera_idx]
            if look is None or region is None or picture is None:
                masks.append(None)
                continue
            masks.append(self._fine(camera_idx, look, region, picture))
        return masks, found

    def _fine(self, camera_idx: int, look: Look, region: Mask, picture: Picture) -> Mask:
        mask = np.zeros(picture.shape[:2], np.uint8)
        x, y, width, height = cv2.boundingRect(region)
        if cv2.countNonZero(region) < _LEAST_COARSE:
            return mask
        step = self.differences[camera_idx].step
        box = (
            slice(max(0, (y - 4) * step), min(mask.shape[0], (y + height + 4) * step)),
            slice(max(0, (x - 4) * step), min(mask.shape[1], (x + width + 4) * step)),
        )
        if self.methods[camera_idx] == "auto":
            reach = max(3, round(max(region.shape) * _OUTLINE_SHARE))
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
            everywhere = (slice(0, mask.shape[0]), slice(0, mask.shape[1]))
            outline = full_size(cv2.dilate(region, disc).astype(np.uint8), step, everywhere) > 0
            outline = _without_shadow(outline, look, step)
            return self._refined(segment(picture, self.backgrounds[camera_idx], outline), picture)
        fine = look.fine(box)
        # What the coarse look kept, and a rim around it that is narrower than a gap to something else.
        near = full_size(cv2.dilate(region, np.ones((5, 5), np.uint8)).astype(np.uint8), step, box)
        fine = cv2.bitwise_and(fine, near)
        fine = cv2.morphologyEx(fine, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask[box] = cv2.morphologyEx(fine, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
        return self._refined(mask, picture)

    def _refined(self, mask: Mask, picture: Picture) -> Mask:
        how = self.options.refine
        # The minimum cut moves its border to the edges itself; the plain methods stay plain.
        return refined(mask, picture, "none" if how == "auto" else how)


def prepare_maker(filmed: Filmed, options: MakerOptions, report: Report = lambda _: None) -> SilhouetteMaker:
    """Learn the backgrounds, find out who the subject is and what the calibration allows.

    report : told what is being done, now and then. Raises RecordingError where a method lacks what it needs.
    """
    method = options.method
    if method == "plate":
        lacking = [camera for camera in filmed.cameras if camera not in filmed.scenes]
        if lacking:
            raise RecordingError(
                f"--method plate: no background plate for {', '.join(lacking)}; film the scene without the "
                "subject into background/<camera>.png, .mp4 or a folder, or use --method median"
            )
    samples = sample_frames(filmed)
    plates: list[Plate] = []
    differences: list[Difference] = []
    methods: list[str] = []
    for camera in filmed.cameras:
        report(f"background of {camera}")
        plate = _plate_of(filmed, camera, samples, method)
        plates.append(plate)
        difference, used = _difference(filmed, camera, samples, plate, options)
        differences.append(difference)
        methods.append(used)
    several = filmed.rig is not None and len(filmed.rig) >= 2
    cut = None
    # A single empty picture may be of another light, or have somebody in it; the film says which.
    corrected = methods.count("auto") * 2 > len(methods) and any(
        plate.n_frames < _MANY_EMPTY and camera in filmed.scenes
        for camera, plate in zip(filmed.cameras, plates, strict=True)
    )
    if several and method == "auto" and corrected:
        assert filmed.rig is not None
        report("backgrounds from all cameras together")
        cut = build_backgrounds(
            filmed.rig,
            [plate.mean for plate in plates],
            lambda camera_idx: filmed.frames.read_several(filmed.cameras[camera_idx], samples),
        )
        methods = ["auto"] * len(methods)
        differences = [PlateDifference.of_plate(Plate(picture, None, 1)) for picture in cut.pictures]
    backgrounds = tuple(plate.mean for plate in plates) if cut is None else cut.pictures
    maker = SilhouetteMaker(
        filmed,
        options,
        tuple(differences),
        cut,
        backgrounds,
        None,
        None,
        tuple(methods),
    )
    if several and cut is None:
        report("who the subject is")
        maker = replace(maker, subject=_subject(maker, _every(samples, _N_PATH)))
    if options.repair and filmed.rig is not None and len(filmed.rig) >= 4:
        report("what the calibration allows")
        made = [maker.make(frame, maker.read(frame)).masks for frame in _every(samples, _N_TOLERANCE)]
        maker = replace(maker, repair=MaskRepair.build(filmed.rig, made))
    return maker


def sample_frames(filmed: Filmed) -> list[int]:
    """Frames to learn from: spread over the chosen ones, or wider if those are few."""
    available = np.array(filmed.frames.frame_ids)
    first, last = (int(np.searchsorted(available, filmed.chosen[end])) for end in (0, -1))
    lacking = max(0, _SHORTEST_SPAN - 1 - (last - first))
    first = max(0, first - lacking // 2)
    last = min(len(available) - 1, max(last, first + _SHORTEST_SPAN - 1))
    first = max(0, min(first, last - _SHORTEST_SPAN + 1))
    return sorted({int(available[idx]) for idx in np.linspace(first, last, _N_SAMPLES).round().astype(int)})


def _every(samples: list[int], n: int) -> list[int]:
    return sorted({samples[int(idx)] for idx in np.linspace(0, len(samples) - 1, n).round()})


def _plate_of(filmed: Filmed, camera: str, samples: list[int], method: str) -> Plate:
    """The camera's empty picture: from its empty scene, or the median over time."""
    scene = filmed.scenes.get(camera)
    if scene is not None and method != "median":
        return learn_plate(scene.frames())
    stack = np.stack(list(filmed.frames.read_several(camera, samples)))
    scene_picture, painted = emptied(stack)
    return median_plate(painted, scene_picture)


def _difference(
    filmed: Filmed, camera: str, samples: list[int], plate: Plate, options: MakerOptions
) -> tuple[Difference, str]:
    """The camera's learnt background, and the method that it is of."""
    method = options.method
    if method in _MIXTURES:
        scene = filmed.scenes.get(camera)
        shown: Iterator[Picture] = (
            scene.frames() if scene is not None else filmed.frames.read_several(camera, samples)
        )
        return train(method, shown), method
    difference = PlateDifference.of_plate(plate)
    if method in ("plate", "median"):
        return difference, method
    if options.key is not None:
        key = key_of_colour(*options.key)
        if key is None:
            raise RecordingError(
                f"--key {','.join(map(str, options.key))}: too near to grey for a screen's colour"
            )
        return KeyDifference.of_plate(difference, key), "chroma"
    found = find_key(plate.mean)
    if found is not None:
        return KeyDifference.of_plate(difference, found[0]), "chroma"
    if method == "chroma":
        raise RecordingError(
            f"--method chroma: camera {camera} shows no screen of one colour; "
            "give its colour with --key R,G,B, or use another method"
        )
    return difference, "auto"


def _subject(maker: SilhouetteMaker, frames: list[int]) -> SubjectChoice:
    assert maker.filmed.rig is not None
    coarse: dict[int, list[Mask | None]] = {}
    for frame_id in frames:
        looks = [
            None if picture is None else difference.look(picture)
            for (picture, _), difference in zip(maker.read(frame_id), maker.differences, strict=True)
        ]
        coarse[frame_id] = [
            None if look is None or look.changed > _LIGHT_CHANGED else look.coarse for look in looks
        ]
    return SubjectChoice.build(maker.filmed.rig, coarse)


def _without_shadow(outline: Bool[np.ndarray, "_h _w"], look: Look, step: int) -> Bool[np.ndarray, "_h _w"]:
    """Where the subject can be, less what is plainly its shadow on the floor: the minimum cut would take a
    dark shadow's grey for a colour that the person wears."""
    if not isinstance(look, PlateLook) or look.shade is None:
        return outline
    everywhere = (slice(0, outline.shape[0]), slice(0, outline.shape[1]))
    return outline & (full_size(look.shade, step, everywhere) == 0)


def _is_empty(mask: Mask | None) -> bool:
    return mask is None or cv2.countNonZero(mask) == 0


def _light_phrase(changed: float) -> str:
    return (
        f"{100 * changed:.0f} % of the picture differs from the background "
        "(did the light change, or the camera move?)"
    )
