"""Stage fit: hulls or scans in; alignments, fusion shape and track out, in the recording's world (paper
sections 4.1 to 4.3).

Finished frames are kept: an alignment on disk is used again as long as body, settings and hull are the same.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bodyhull.config import RunConfig, digest
from bodyhull.errors import UserError
from bodyhull.fit_input import input_of, read_frames
from bodyhull.folder import RunFolder, load_arrays, save_arrays
from fit.align import Alignment, align_sequence
from fit.body.model import BodyModel, load_body
from fit.body.pose_prior import PosePrior
from fit.frames import apply
from fit.fuse import FusionShape, fused
from fit.hull_excess import hull_excess
from fit.initialise import PoseFinder
from fit.settings import FitSettings
from fit.skin import labelled
from fit.solver import Fitter
from fit.state import BodyState
from fit.thickness import Thickness
from fit.track import TrackedFrame, posed_vertices, track_sequence
from hull.mesh_file import save_mesh
from hull.scan import Scan


def fit_stage(config: RunConfig, settings: FitSettings | None = None) -> None:
    """Fit the run's hulls or scans. Raises UserError where there is none, or where another body's fit is
    there."""
    settings = config.adapted(settings)
    folder = RunFolder(config.out)
    source = input_of(config)
    state = folder.require_state()
    model = load_body(config.body)
    prior = _pose_prior(config.pose_prior)
    settings_key = digest(
        {
            "body": model.content_hash,
            "keypoints": keypoints_print(config.keypoints),
            "pose_prior": prior.content_hash,
            "settings": asdict(settings),
        }
        | ({"labels": config.labels} if config.labels != "auto" else {})
    )
    key = digest({"settings": settings_key, "input": source.print})
    entry = state.get("stages", {}).get("fit", {})
    if entry.get("key") == key and _finished(folder, source.all_ids) and not config.overwrite:
        return
    if entry and entry.get("settings_key") != settings_key and not config.overwrite:
        raise UserError(
            f"{folder.root}: holds a fit of body '{entry.get('body')}' made with other settings "
            f"({entry.get('settings_key')}, asked for: body '{config.body}', {settings_key}); "
            f"to replace it: bodyhull fit {folder.root} --body {config.body} --overwrite"
        )
    started = time.perf_counter()
    state["configuration"] |= {k: config.as_dict()[k] for k in config.fit_settings()}
    folder.write_state(state)
    folder.update_stage(
        "fit",
        key="",
        settings_key=settings_key,
        body=config.body,
        body_hash=model.content_hash,
        kind=model.kind,
        gender=model.gender,
        settings=asdict(settings),
    )
    for note in model.notes:
        tqdm.write(f"body: {note}", file=sys.stderr)
    fitter, finder = Fitter.of(model), PoseFinder.of(model, prior)
    world_from_body = source.world_from_body
    scans = read_frames(source, settings.n_points, settings.seed)
    keypoints = _keypoints(config, source.frame_ids, world_from_body) if config.keypoints is not None else {}
    alignments = _align(folder, fitter, finder, scans, keypoints, settings, settings_key, config.overwrite)
    if all(a.status == "failed" for a in alignments):
        raise UserError(f"{folder.root}: no frame could be aligned; {alignments[0].message}")
    shares = None
    if config.labels != "none":
        scans, shares = labelled(fitter, scans, alignments, settings)
    _save_labels(folder, shares)
    excess = hull_excess(fitter, scans, alignments)
    fusion, alignments = fused(fitter, finder, alignments, settings, shares, excess)
    _save_fusion(folder, model, fusion, world_from_body)
    with tqdm(total=len(alignments), desc="track", unit="frame") as bar:
        track = track_sequence(
            fitter,
            finder,
            fusion,
            alignments,
            scans,
            settings,
            report=lambda frame: bar.update(),
            container_of=source.container,
        )
    track = [*track, *_without_scan(source.failed, fusion)]
    track.sort(key=lambda frame: frame.frame_id)
    _save_track(folder, fitter, fusion, track, world_from_body)
    for frame in track:
        if frame.message:
            tqdm.write(f"warning: {frame.message}", file=sys.stderr)
    folder.update_stage(
        "fit",
        key=key,
        seconds=round(time.perf_counter() - started, 2),
        frames={
            f"{f.frame_id:06d}": {
                "status": f.status,
                "problems": [f.message] if f.message else [],
                "distance_mm": round(1e3 * f.distance_m, 3) if np.isfinite(f.distance_m) else None,
            }
            for f in track
        },
    )


def _without_scan(failed: dict[int, str], fusion: FusionShape) -> list[TrackedFrame]:
    """The frames without hull or scan: kept in the track, without a pose (NaN), with the reason."""
    lost = np.full_like(fusion.template, np.nan)
    pose, shift = np.full_like(fusion.joints, np.nan), np.full(3, np.nan)
    return [
        TrackedFrame(frame_id, BodyState(lost, pose, shift, fusion.betas), np.inf, "failed", reason)
        for frame_id, reason in failed.items()
    ]


def _save_labels(folder: RunFolder, shares: Mapping[int, np.ndarray] | None) -> None:
    """g of every vertex of every alignment, or nothing where all is cloth."""
    if shares is None:
        folder.skin.unlink(missing_ok=True)
    else:
        save_arrays(folder.skin, frame_ids=np.array(list(shares)), skin_share=np.stack(list(shares.values())))


def keypoints_print(folder: Path | None) -> str | None:
    """A short hash over names, sizes and times of all files of a keypoints folder."""
    if folder is None:
        return None
    files = sorted(p for p in folder.rglob("*.json") if p.is_file())
    return digest([(str(p.relative_to(folder)), p.stat().st_size, p.stat().st_mtime_ns) for p in files])


def _pose_prior(path: Path | None) -> PosePrior:
    """The prior of this file, or the built-in one. Raises UserError where the file is no prior."""
    if path is None:
        return PosePrior.standard()
    try:
        return PosePrior.load(path)
    except ValueError as error:
        raise UserError(str(error)) from error


def _finished(folder: RunFolder, frame_ids: list[int]) -> bool:
    track = load_arrays(folder.track)
    return (
        track is not None
        and load_arrays(folder.fusion) is not None
        and set(frame_ids) == set(track["frame_ids"].tolist())
        and all(
            folder.mesh(k).is_file() or status == "failed"
            for k, status in zip(track["frame_ids"].tolist(), track["status"].tolist(), strict=True)
        )
    )


def _keypoints(config: RunConfig, frame_ids: list[int], world_from_body: np.ndarray) -> dict[int, np.ndarray]:
    """Triangulated keypoints a frame, in the body's frame."""
    from bodyhull.carving import open_for
    from capture.keypoints import read_keypoints, triangulate_keypoints

    recording = open_for(config)
    assert config.keypoints is not None
    out = {}
    for frame_id in tqdm(frame_ids, desc="keypoints", unit="frame", leave=False):
        detections = read_keypoints(config.keypoints, recording.rig.names, frame_id)
        silhouettes = recording.silhouettes(frame_id)
        points = triangulate_keypoints(recording.calibration, detections, silhouettes.images)
        points[:, :3] = points[:, :3] @ world_from_body[:3, :3]
        out[frame_id] = points
    return out


def _align(
    folder: RunFolder,
    fitter: Fitter,
    finder: PoseFinder,
    scans: dict[int, Scan],
    keypoints: dict[int, np.ndarray],
    settings: FitSettings,
    settings_key: str,
    overwrite: bool,
) -> list[Alignment]:
    """Alignments from disk where they are still valid, the rest made and written one by one."""
    prints = {
        k: digest([settings_key, float(s.points.sum()), float(np.abs(s.points).sum())])
        for k, s in scans.items()
    }
    done: dict[int, Alignment] = {}
    if not overwrite:
        for k in scans:
            found = _load_alignment(folder.alignment(k), prints[k])
            if found is not None:
                done[k] = found
    if done:
        tqdm.write(f"align: {len(done)} of {len(scans)} frames are done already", file=sys.stderr)
    with tqdm(total=len(scans), initial=len(done), desc="align", unit="frame") as bar:

        def keep(alignment: Alignment) -> None:
            _save_alignment(folder.alignment(alignment.frame_id), alignment, prints[alignment.frame_id])
            if bar.n < len(scans):  # a second look tells of some frames again
                bar.update()

        frames = [(k, scan, keypoints.get(k)) for k, scan in scans.items()]
        return align_sequence(fitter, finder, frames, settings, keep, done)


def _state_arrays(state: BodyState) -> dict[str, np.ndarray]:
    return {
        "template": state.template,
        "pose": state.pose,
        "translation": state.translation,
        "betas": state.betas,
    }


def _save_alignment(path: Path, alignment: Alignment, fingerprint: str) -> None:
    save_arrays(
        path,
        **_state_arrays(alignment.state),
        frame_id=alignment.frame_id,
        score=alignment.score,
        distance_m=alignment.distance_m,
        status=alignment.status,
        message=alignment.message,
        coarse_m=alignment.coarse_m,
        left_out=alignment.left_out,
        outside=alignment.outside,
        tried=alignment.tried,
        lost=alignment.lost,
        fingerprint=fingerprint,
    )


def _load_alignment(path: Path, fingerprint: str) -> Alignment | None:
    found = load_arrays(path)
    if found is None or str(found.get("fingerprint")) != fingerprint or "lost" not in found:
        return None
    state = BodyState(found["template"], found["pose"], found["translation"], found["betas"])
    return Alignment(
        int(found["frame_id"]),
        state,
        float(found["score"]),
        float(found["distance_m"]),
        str(found["status"]),
        str(found["message"]),
        float(found["coarse_m"]),
        float(found["left_out"]),
        float(found["outside"]),
        bool(found["tried"]),
        bool(found["lost"]),
    )


def _save_fusion(
    folder: RunFolder, model: BodyModel, fusion: FusionShape, world_from_body: np.ndarray
) -> None:
    save_arrays(
        folder.fusion,
        template=fusion.template,
        betas=fusion.betas,
        joints=fusion.joints,
        spread=fusion.spread,
        fit_scale=fusion.fit_scale,
        trust=fusion.trust,
        **_clothes(fusion),
        faces=model.faces,
        body=model.name,
        body_hash=model.content_hash,
    )
    save_mesh(folder.fusion_mesh, apply(world_from_body, fusion.template), model.faces)


def _clothes(fusion: FusionShape) -> dict[str, np.ndarray]:
    """What is known of the clothes, for the file; nothing where their movement could not be read."""
    if fusion.thickness is None or fusion.confidence is None:
        return {}
    return {
        "thickness": fusion.thickness.expected,
        "tolerance": fusion.thickness.tolerance,
        "movement": fusion.thickness.movement,
        "confidence": fusion.confidence,
    }


def load_fusion(folder: RunFolder) -> FusionShape:
    """The fusion shape of a finished fit."""
    found = load_arrays(folder.fusion)
    if found is None:
        raise UserError(f"{folder.fusion}: missing or damaged; run: bodyhull fit {folder.root}")
    return FusionShape(
        found["template"],
        found["betas"],
        found["joints"],
        found["spread"],
        found["fit_scale"],
        float(found["trust"]),
        Thickness(found["thickness"], found["tolerance"], found["movement"])
        if "confidence" in found
        else None,
        found.get("confidence"),
    )


def _save_track(
    folder: RunFolder,
    fitter: Fitter,
    fusion: FusionShape,
    track: list[TrackedFrame],
    world_from_body: np.ndarray,
) -> None:
    for frame in track:
        path = folder.mesh(frame.frame_id)
        path.parent.mkdir(parents=True, exist_ok=True)
        if frame.status == "failed":
            path.unlink(missing_ok=True)
            continue
        save_mesh(path, apply(world_from_body, posed_vertices(fitter, fusion, frame)), fitter.model.faces)
    save_arrays(
        folder.track,
        frame_ids=np.array([f.frame_id for f in track]),
        pose=np.stack([f.state.pose for f in track]),
        translation=np.stack([f.state.translation for f in track]),
        betas=fusion.betas,
        joints=fusion.joints,
        templates=np.stack([f.state.template for f in track]),
        status=np.array([f.status for f in track]),
        message=np.array([f.message for f in track]),
        distance_m=np.array([f.distance_m for f in track]),
        recording_from_body=world_from_body,
        faces=fitter.model.faces,
        body=fitter.model.name,
        body_hash=fitter.model.content_hash,
        kind=fitter.model.kind,
        gender=fitter.model.gender,
    )


def load_track(folder: RunFolder) -> dict[str, Any]:
    """Arrays of track.npz."""
    found = load_arrays(folder.track)
    if found is None:
        raise UserError(f"{folder.track}: missing or damaged; run: bodyhull fit {folder.root}")
    return found
