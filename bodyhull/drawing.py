"""Stage render: overlay films of every camera, and the report page."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from tqdm import tqdm

from bodyhull.carving import open_for, refuse_other_input
from bodyhull.config import RunConfig, digest
from bodyhull.errors import UserError
from bodyhull.fit_input import is_of_scans
from bodyhull.fitting import load_fusion, load_track
from bodyhull.folder import RunFolder
from capture.recording import Recording
from hull.mesh_file import load_mesh
from render.overlay import agreement_picture, body_surface, crop_around, intersection_over_union, overlay
from render.report import Image, ReportData, Row, Table, write_report
from render.scene import Renderer
from render.shape_views import shape_views
from render.video import write_video

#: Frames and cameras that the contact sheet shows.
SHEET_FRAMES, SHEET_CAMERAS = 3, 4
HULL_RGB = (150, 170, 210)
FILM_PX = 1280


def draw_stage(config: RunConfig) -> None:
    """Draw the overlay films (skipping finished ones) and write the report."""
    from render.gl import choose_platform

    choose_platform()
    folder = RunFolder(config.out)
    if is_of_scans(folder.require_state()):
        raise UserError(
            f"{folder.root}: was made from scans, and films need cameras and pictures; look at the bodies in "
            f"{folder.mesh(0).parent}"
        )
    track = load_track(folder)
    recording = open_for(config)
    refuse_other_input(folder, recording.fingerprint())
    fit_key = folder.stage("fit").get("key")
    if not fit_key:
        raise UserError(
            f"{folder.root}: its fit was stopped half-way; go on with: bodyhull fit {folder.root}"
        )
    entry = folder.stage("render")
    good = [int(k) for k, s in zip(track["frame_ids"], track["status"], strict=True) if s != "failed"]
    agreement: dict[str, list[float | None]] = (
        dict(entry.get("agreement", {})) if entry.get("fit_key") == fit_key else {}
    )
    started = time.perf_counter()
    todo = [
        k
        for k, camera in enumerate(recording.rig)
        if config.overwrite or camera.name not in agreement or not folder.overlay(camera.name).is_file()
    ]
    with tqdm(total=len(todo) * len(good), desc="overlay", unit="picture", disable=not todo) as bar:
        for camera_idx in todo:
            scores: list[float | None] = []
            film = folder.overlay(recording.rig[camera_idx].name)
            film.parent.mkdir(parents=True, exist_ok=True)
            write_video(
                film,
                _film(recording, folder, track, camera_idx, good, scores, bar),
                fps=_fps(recording, good),
            )
            agreement[recording.rig[camera_idx].name] = scores
            folder.update_stage("render", fit_key=fit_key, agreement=agreement, frames=good)
    if todo:
        folder.update_stage("render", seconds=round(time.perf_counter() - started, 2))
    if todo or not folder.report.is_file() or folder.stage("render").get("report_key") != report_key(folder):
        write_run_report(config, recording, track)


def _fps(recording: Recording, frames: list[int]) -> float:
    """Films play at a pace at which every frame can be seen: 30 a second for long recordings, slower for
    short ones."""
    return 30.0 if len(frames) > 90 else 12.0 if len(frames) > 24 else 6.0


def _film(
    recording: Recording,
    folder: RunFolder,
    track: dict[str, Any],
    camera_idx: int,
    frames: list[int],
    scores: list[float | None],
    bar: tqdm,
) -> Iterator[np.ndarray]:
    """One camera's overlay pictures; the agreement of every frame is appended to `scores` on the way."""
    from render.overlay import blend_drawing, captioned, outline, shrunk

    camera = recording.rig[camera_idx]
    renderer = Renderer(*camera.size)
    for frame_id in frames:
        vertices, faces = load_mesh(folder.mesh(frame_id))
        drawing = renderer.stage([body_surface(vertices, faces)]).colour(camera)
        silhouette = recording.silhouettes(frame_id).images[camera_idx]
        picture = recording.picture(camera_idx, frame_id)
        if silhouette is None:
            scores.append(None)
        else:
            value = intersection_over_union(drawing.mask, silhouette)
            scores.append(round(value, 5) if np.isfinite(value) else None)
        if picture is None:
            picture = np.full((camera.size[1], camera.size[0], 3), 58, np.uint8)
            if silhouette is not None:
                picture[silhouette == 255] = 236
        blended = blend_drawing(picture, drawing)
        if silhouette is not None:
            blended[outline(silhouette == 255)] = (255, 214, 70)
        yield captioned(shrunk(blended, FILM_PX), f"{camera.name}   frame {frame_id:06d}")
        bar.update()


def report_key(folder: RunFolder) -> str:
    """What the report's content depends on; where it has not changed, the page on disk is the one that would
    be written."""
    stages = folder.read_state()["stages"]
    return digest(
        {"stages": {k: v for k, v in stages.items() if k != "render"}, "errors": current_errors(folder)}
    )


def current_errors(folder: RunFolder) -> dict[str, Any] | None:
    """The evaluation of the fit that the folder holds now, or None: an earlier fit's errors are not this
    one's."""
    try:
        errors = json.loads(folder.evaluation.read_text())
    except (OSError, ValueError):
        return None
    return errors if errors.get("fit_key") == folder.stage("fit").get("key") else None


def write_run_report(config: RunConfig, recording: Recording, track: dict[str, Any]) -> None:
    """Write report.html from what run.json and the evaluation know."""
    folder = RunFolder(config.out)
    state = folder.read_state()
    stages = state["stages"]
    good = stages["render"]["frames"]
    scores = {
        name: [v for v in values if v is not None] for name, values in stages["render"]["agreement"].items()
    }
    everything = [v for values in scores.values() for v in values]
    hull_frames, fit_frames = stages["hull"]["frames"], stages["fit"]["frames"]
    problems = [note for note in recording.notes if note not in recording.settled]
    for name, entry in (*hull_frames.items(), *fit_frames.items()):
        told = (p if f"frame {name}" in p else f"frame {name}: {p}" for p in entry["problems"])
        problems += [p for p in told if p not in problems]
    hull_scores = {
        name: [
            f["agreement"][k]
            for f in hull_frames.values()
            if f["agreement"] and f["agreement"][k] is not None
        ]
        for k, name in enumerate(recording.rig.names)
    }
    tables = [
        Table(
            "Cameras",
            ("camera", "size", "hull IoU", "body IoU", "worst body IoU"),
            tuple(
                (
                    camera.name,
                    f"{camera.size[0]} x {camera.size[1]}",
                    _median(hull_scores[camera.name]),
                    _median(scores.get(camera.name, [])),
                    min(scores.get(camera.name, []), default=None),
                )
                for camera in recording.rig
            ),
            "Intersection over union of the projected surface with the silhouette, median over frames. Under "
            "loose clothes a right body covers less than the silhouette.",
            digits=3,
        ),
        Table(
            "Frames",
            ("frame", "hull", "fit", "scan to body, mm"),
            tuple(
                (
                    f,
                    hull_frames[f]["status"],
                    fit_frames.get(f, {}).get("status", "-"),
                    fit_frames.get(f, {}).get("distance_mm"),
                )
                for f in sorted(hull_frames)
            ),
            "Mean distance of the hull's points to the body: mostly cloth, not error.",
        ),
    ]
    headline: list[tuple[str, str]] = [
        ("frames fitted", f"{len(good)} of {len(hull_frames)}"),
        ("body over silhouette, IoU", f"{_median(everything):.3f}" if everything else "-"),
    ]
    errors = current_errors(folder)
    if errors is not None:
        tables.insert(0, error_table(errors))
        headline.append(
            ("fusion shape, paper's measure", f"{errors['summary']['fusion, paper']['rms']:.2f} mm RMS")
        )
        headline.append(("posed body, direct", f"{errors['summary']['detailed, direct']['rms']:.2f} mm RMS"))
    facts = [
        ("recording", f"{state['inputs']['recording']} {recording.name}".strip()),
        ("body model", str(stages["fit"]["body"])),
        ("unit of the calibration", f"{recording.unit} ({recording.metres_per_unit:g} m)"),
        ("up", " ".join(f"{v:g}" for v in recording.up)),
        ("voxel", f"{config.voxel_mm:g} mm"),
        *(
            (f"seconds, {name}", f"{stages[name].get('seconds', 0):.1f}")
            for name in ("hull", "fit", "render")
        ),
        *((name, str(version)) for name, version in state.get("software", {}).items()),
    ]
    title = recording.name or config.recording.resolve().name
    folder.report.parent.mkdir(parents=True, exist_ok=True)
    write_report(
        folder.report,
        ReportData(
            title=f"bodyhull: {title}",
            subtitle=f"{len(recording.rig)} cameras, {len(hull_frames)} frames, body {stages['fit']['body']}",
            headline=tuple(headline),
            problems=tuple(problems),
            notes=recording.settled,
            facts=tuple(facts),
            pictures=_shape_pictures(folder),
            tables=tuple(tables),
            sheet_headers=("picture", "silhouette", "hull", "body", "overlay", "agreement"),
            sheet=tuple(_contact_sheet(recording, folder, good)),
            films=tuple((name, f"overlay/{name}.mp4") for name in recording.rig.names),
        ),
    )
    folder.update_stage("render", report_key=report_key(folder))


def _shape_pictures(folder: RunFolder) -> tuple[Image, ...]:
    """The fusion shape coloured by what is known of the clothes; none where that could not be told."""
    fusion = load_fusion(folder)
    if fusion.thickness is None or fusion.confidence is None:
        return ()
    faces = load_track(folder)["faces"]
    views = shape_views(
        fusion.template,
        faces,
        [
            ("cloth 0-40 mm", 1e3 * fusion.thickness.expected, 0.0, 40.0),
            ("confidence 0-1", fusion.confidence, 0.0, 1.0),
        ],
    )
    return (
        Image(
            views,
            "The fusion shape. Above: how far the clothes stand away, as their movement tells. "
            "Below: confidence in the place of the skin; 1: as well known as bare skin.",
        ),
    )


def error_table(errors: dict[str, Any]) -> Table:
    """The evaluation as a table."""
    rows = tuple(
        (name, e["rms"], e["mean"], e["bias"], e["p90"]) for name, e in errors["summary"].items()
    ) + tuple(
        (f"detailed, direct: {name}", e["rms"], e["mean"], e["bias"], e["p90"])
        for name, e in errors["parts"].items()
    )
    return Table(
        "Errors against the true body, mm", ("what", "RMS", "mean", "bias", "90 %"), rows, errors["protocol"]
    )


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def _contact_sheet(recording: Recording, folder: RunFolder, frames: list[int]) -> Iterator[Row]:
    """Picture, silhouette, hull, body, overlay and agreement for some frames and cameras spread over the
    run."""
    chosen = sorted(
        {frames[i] for i in np.linspace(0, len(frames) - 1, min(SHEET_FRAMES, len(frames))).astype(int)}
    )
    cameras = sorted({int(i) for i in np.linspace(0, len(recording.rig), SHEET_CAMERAS, endpoint=False)})
    for frame_id in tqdm(chosen, desc="contact sheet", unit="frame", leave=False):
        body, hull = load_mesh(folder.mesh(frame_id)), load_mesh(folder.hull(frame_id))
        silhouettes = recording.silhouettes(frame_id)
        for camera_idx in cameras:
            camera = recording.rig[camera_idx]
            renderer = Renderer(*camera.size)
            silhouette, picture = silhouettes.images[camera_idx], recording.picture(camera_idx, frame_id)
            drawings = []
            for (vertices, faces), rgb in ((hull, HULL_RGB), (body, None)):
                surface = body_surface(vertices, faces) if rgb is None else body_surface(vertices, faces, rgb)
                drawings.append(renderer.stage([surface]).colour(camera))
            plain = [_on_paper(d.colour, d.coverage) for d in drawings]
            over = overlay(camera, [body_surface(*body)], picture, silhouette)
            box = crop_around([d.mask for d in drawings])
            rows, columns = box if box is not None else (slice(None), slice(None))

            def cut(image: np.ndarray | None, rows: slice = rows, columns: slice = columns) -> Image | None:
                return None if image is None else Image(np.ascontiguousarray(image[rows, columns]))

            score = None if silhouette is None else agreement_picture(drawings[1].mask, silhouette)
            images = (cut(picture), cut(silhouette), cut(plain[0]), cut(plain[1]), cut(over), cut(score))
            yield Row(f"frame {frame_id:06d}, {camera.name}", images)


def _on_paper(colour: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    return np.clip(
        colour.astype(np.float32) + 0.92 * (255 - coverage[:, :, None].astype(np.float32)), 0, 255
    ).astype(np.uint8)
