"""`bodyhull evaluate`: a run against the true naked body, in millimetres, by the paper's measure and
directly."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from bodyhull.config import RunConfig
from bodyhull.errors import UserError
from bodyhull.fit_input import input_of
from bodyhull.fitting import load_fusion, load_track
from bodyhull.folder import RunFolder, write_atomically
from fit.body.model import load_body
from fit.body.parts import region_of_vertices
from fit.evaluate import (
    ErrorSummary,
    Penetration,
    Rig,
    Surface,
    average,
    inside_share,
    mean_penetration,
    penetration,
    pose_truth_to,
    signed_error_mm,
    summarise,
    transfer_rig,
)
from fit.solver import Fitter
from fit.state import BodyState
from fit.surface import vertex_areas
from fit.truth import SCORED_REGIONS, load_shape_truth, load_truth

#: Points of a frame that are looked for inside the body.
PENETRATION_POINTS = 20_000

PROTOCOL = (
    "Distance from true vertices to the result's surface: outer vertices of torso, arms, legs and neck, "
    "weighted by area, all frames. 'paper': the true body is first re-posed to fit the result (Zhang et al. "
    "2017, section 6.2); 'direct': as it stands in that frame. Bias is positive where the result is too fat. "
    "Penetration: points of the hull or scan, even in area, that lie inside the body by more than 1 mm, and "
    "how deep these lie."
)


def evaluate_stage(config: RunConfig, truth_path: Path) -> dict[str, Any]:
    """Compute all errors, write evaluate/errors.json, return them.

    Raises UserError or TruthError where the run is not finished or the truth is not found.
    """
    folder = RunFolder(config.out)
    state = folder.require_state()
    track, fusion = load_track(folder), load_fusion(folder)
    source = input_of(config)
    shape = load_shape_truth(truth_path)
    truth = None if shape is not None else load_truth(truth_path, state["recording"]["name"])
    fit = state["stages"]["fit"]
    model = load_body(fit["body"])
    if model.content_hash != str(track["body_hash"]):
        raise UserError(
            f"{folder.root}: was fitted with another version of body '{fit['body']}' "
            f"({str(track['body_hash'])[:12]}, now {model.content_hash[:12]}); "
            f"run: bodyhull fit {folder.root} --overwrite"
        )
    fitter = Fitter.of(model)
    world_from_body = track["recording_from_body"]
    rotation, shift = world_from_body[:3, :3], world_from_body[:3, 3]
    if shape is not None and shape.body_hash != model.content_hash:
        raise UserError(
            f"{truth_path}: is a shape of another body than the run's '{fit['body']}'; "
            f"make it with --body {fit['body']}"
        )
    faces = track["faces"]
    true_faces, region, scored = (
        (truth.faces, truth.region, truth.scored)
        if truth is not None
        else (faces, region_of_vertices(model), np.isin(region_of_vertices(model), SCORED_REGIONS))
    )
    rows: dict[str, list[ErrorSummary]] = {}
    parts: dict[str, list[ErrorSummary]] = {name: [] for name in SCORED_REGIONS}
    outside, missing, used = [], [], 0
    pressed: dict[str, list[Penetration]] = {"fusion": [], "detailed": []}

    def note(name: str, vertices: np.ndarray, surface: Surface) -> np.ndarray:
        error = signed_error_mm(vertices[scored], surface)
        rows.setdefault(name, []).append(summarise(error, vertex_areas(vertices, true_faces)[scored]))
        return error

    for k, frame_id in enumerate(tqdm(track["frame_ids"].tolist(), desc="evaluate", unit="frame")):
        in_world = None if truth is None else truth.frame(frame_id)
        if (truth is not None and in_world is None) or track["status"][k] == "failed":
            missing.append(frame_id)
            continue
        used += 1
        pose, translation = track["pose"][k], track["translation"][k]
        detailed_state = BodyState(track["templates"][k], pose, translation, fusion.betas)
        fusion_state = BodyState(fusion.template, pose, translation, fusion.betas)
        detailed = Surface(fitter.posed(detailed_state, fusion.joints), faces)
        fused = Surface(fitter.posed(fusion_state, fusion.joints), faces)
        joints = fitter.posed_joints(detailed_state, fusion.joints)
        container = source.container(frame_id)
        hull = None if container is None else Surface(container.vertices, container.faces)
        true = None if in_world is None else (in_world - shift) @ rotation
        if true is not None and hull is not None:
            note("hull, direct", true, hull)
        points = source.scan(frame_id, PENETRATION_POINTS, 0).points
        for name, surface in (("fusion", fused), ("detailed", detailed)):
            pressed[name].append(penetration(points, surface))
            if true is not None:
                error = note(f"{name}, direct", true, surface)
                if name == "detailed":
                    area = vertex_areas(true, true_faces)
                    for part in SCORED_REGIONS:
                        chosen = region[scored] == part
                        parts[part].append(summarise(error[chosen], area[scored][chosen]))
                rig = transfer_rig(true, surface, model.weights, joints, model.parents)
                start = true
            else:
                assert shape is not None
                start = fitter.posed(fusion_state.moved(template=shape.template), shape.joints)
                at = fitter.posed_joints(fusion_state, shape.joints)
                rig = Rig(model.weights, at, model.parents)
            note(f"{name}, paper", pose_truth_to(start, true_faces, scored, rig, surface), surface)
        if hull is not None:
            outside.append(inside_share(detailed.vertices, hull))
    if not used:
        raise UserError(
            f"{truth_path}: the truth holds none of the run's fitted frames ({track['frame_ids'].tolist()})"
        )
    order = ("hull, direct", "fusion, direct", "detailed, direct", "fusion, paper", "detailed, paper")
    errors: dict[str, Any] = {
        "protocol": PROTOCOL,
        "fit_key": fit["key"],
        "frames": used,
        "frames_without_truth_or_fit": missing,
        "summary": {name: asdict(average(rows[name])) for name in order if name in rows},
        "parts": {
            name: asdict(average([s for s in values if np.isfinite(s.rms)]))
            for name, values in parts.items()
            if values
        },
        "detailed_rms_by_frame": [s.rms for s in rows.get("detailed, direct", rows["detailed, paper"])],
        "body_outside_hull_share": float(np.mean(outside)) if outside else None,
        "scan_inside_body": {name: asdict(mean_penetration(values)) for name, values in pressed.items()},
    }
    write_atomically(folder.evaluation, lambda path: path.write_text(json.dumps(errors, indent=1) + "\n"))
    return errors


def error_text(errors: dict[str, Any]) -> str:
    """The errors as a table for the terminal."""
    lines = [f"{'error, mm':<26}{'RMS':>8}{'mean':>8}{'bias':>8}{'90 %':>8}"]
    entries = [
        *errors["summary"].items(),
        *((f"detailed, direct: {k}", v) for k, v in errors["parts"].items()),
    ]
    lines += [
        f"{name:<26}{e['rms']:8.2f}{e['mean']:8.2f}{e['bias']:+8.2f}{e['p90']:8.2f}" for name, e in entries
    ]
    if errors["body_outside_hull_share"] is not None:
        outside = 100 * errors["body_outside_hull_share"]
        lines.append(f"{'body outside the hull':<26}{outside:7.2f}% of its vertices (by more than 1 mm)")
    for name, e in errors["scan_inside_body"].items():
        what = f"scan inside the body, {name}"
        lines.append(
            f"{what:<31}{100 * e['share']:7.2f}% of its area (by more than 1 mm), "
            f"deep {e['mean_mm']:.1f} mm on average, {e['p95_mm']:.1f} mm at 95 %"
        )
    return "\n".join(lines)
