"""How near the body model comes to naked people of another model: pose and shape only, no free-form template.

    python -m benchmarks.body_people FOLDER [--body free:neutral] [--components 10 16 64] [--freeform]

FOLDER holds one truth file a sequence (`fit.truth`: vertices (T V 3), faces, region, outer; z up), as
`bodyhull synth` and the evaluation use them. One set of shape coefficients fits all frames of a
sequence, with a pose a frame, by least squares from the true vertices to the model's surface. Printed: RMS
and bias over outer vertices of torso, arms, legs and neck (mm, weighted by area), by region, and the largest
coefficient.

--freeform adds what the skinning alone leaves (`benchmarks.body_freeform`): one free template for all frames
of a person (the sequences whose names begin alike, up to the first underscore), and the same on the half of
the frames that the template was not fitted to.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve

from benchmarks.body_freeform import FreeForm, Points, fit_freeform, on_unseen_frames
from benchmarks.hull import machine
from fit.body.model import BodyModel, load_body
from fit.body.pose_prior import PosePrior
from fit.body.skinning import SkinningArrays, joints_from_betas, shape_template, skin, skin_with_jacobian
from fit.closest import closest_points
from fit.coarse import CoarsePose, CoarseScan
from fit.evaluate import Surface, signed_error_mm, summarise
from fit.frames import recording_from_body
from fit.initialise import PoseFinder
from fit.surface import vertex_areas, vertex_normals
from fit.truth import SCORED_REGIONS, Truth, load_truth

N_SAMPLES = 3500
UNSCORED_SHARE = 0.1  # hands, feet and head still say where the limbs are
SIGMA_M = 0.004
POSE_WEIGHT = 2e-3
ITERATIONS = 14


@dataclass(frozen=True)
class Fitted:
    """betas (B), poses (T J 3), translations (T 3) of one person in the body's frame."""

    betas: Float[np.ndarray, "b"]
    poses: Float[np.ndarray, "t j 3"]
    translations: Float[np.ndarray, "t 3"]


def in_body_frame(truth: Truth) -> Float[np.ndarray, "t v 3"]:
    """True vertices with y up."""
    return truth.vertices @ recording_from_body(np.array([0.0, 0.0, 1.0]))[:3, :3]


def start_poses(model: BodyModel, truth: Truth) -> list[CoarsePose]:
    """A rough pose for every frame: the first from the surface alone, the others from their neighbours."""
    finder = PoseFinder.of(model, PosePrior.standard())
    found: list[CoarsePose] = []
    centroid = np.zeros(3)
    for vertices in in_body_frame(truth):
        normals = vertex_normals(vertices, truth.faces)
        chosen = _samples(truth, vertices, 3000)[0]
        scan = CoarseScan.of(vertices[chosen], normals[chosen])
        at = finder.from_previous(scan, found[-1], centroid) if found else finder.from_hull(scan)[0]
        found.append(at)
        centroid = scan.points.mean(0)
    return found


def _samples(truth: Truth, vertices: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of n outer vertices evenly over the skin, and their weights (mean 1 over scored ones)."""
    area = vertex_areas(vertices, truth.faces) * truth.outer
    cumulative = np.cumsum(area)
    chosen = np.unique(np.searchsorted(cumulative, (np.arange(n) + 0.5) / n * cumulative[-1]))
    return chosen, np.where(truth.scored[chosen], 1.0, UNSCORED_SHARE)


def fit_person(
    model: BodyModel, truth: Truth, starts: list[CoarsePose], *, shape_weight: float = 0.05
) -> Fitted:
    """Gauss-Newton over one shape and a pose a frame; shape coefficients have a unit Gaussian prior."""
    arrays = SkinningArrays.of(model)
    prior = PosePrior.standard()
    n_pose, n_betas = 3 * model.n_joints + 3, model.n_betas
    frames = in_body_frame(truth)
    chosen, weight = _samples(truth, frames[0], N_SAMPLES)
    weight = weight / weight.sum() / SIGMA_M**2
    betas = np.zeros(n_betas)
    betas[: min(4, n_betas)] = np.mean([s.betas[:4] for s in starts], 0)[: min(4, n_betas)]
    poses = np.array([s.pose for s in starts])
    translations = np.array([s.translation for s in starts])
    directions = model.shape_directions
    precision = POSE_WEIGHT * prior.precision
    for _ in range(ITERATIONS):
        template = np.asarray(shape_template(arrays, betas))
        joints = joints_from_betas(arrays, betas)
        h_bb, g_b = (
            np.eye(n_betas) * shape_weight * len(frames) / 12,
            -betas * shape_weight * len(frames) / 12,
        )
        solved = []
        for k, vertices in enumerate(frames):
            target = vertices[chosen]
            posed, rotations, jacobian = (
                np.asarray(x) for x in skin_with_jacobian(arrays, template, joints, poses[k], translations[k])
            )
            found = closest_points(posed, model.faces, target)
            corners = model.faces[found.triangle_idx]
            full = np.zeros((len(target), n_pose + n_betas))
            for c in range(3):
                v = corners[:, c]
                share = found.barycentric[:, c, None]
                full += share * np.einsum("na,nap->np", found.direction, jacobian[v])
                turned = np.einsum("na,nab->nb", found.direction, rotations[v])
                full[:, n_pose:] += share * np.einsum("nb,nbk->nk", turned, directions[v])
            pull = full * weight[:, None]
            h, g = pull.T @ full, pull.T @ found.distance  # distance falls by J x
            a = h[:n_pose, :n_pose] + 1e-6 * np.eye(n_pose)
            a[3:-3, 3:-3] += precision
            rhs = g[:n_pose].copy()
            rhs[3:-3] -= precision @ (poses[k].ravel()[3:] - prior.mean)
            cross = h[:n_pose, n_pose:]
            factor = cho_factor(a)
            solved.append((factor, cross, rhs))
            h_bb += h[n_pose:, n_pose:] - cross.T @ cho_solve(factor, cross)
            g_b += g[n_pose:] - cross.T @ cho_solve(factor, rhs)
        step = np.linalg.solve(h_bb, g_b)
        step *= min(1.0, 2.0 / max(np.abs(step).max(), 1e-9))
        betas = betas + step
        for k, (factor, cross, rhs) in enumerate(solved):
            move = cho_solve(factor, rhs - cross @ step)
            move *= min(1.0, 0.5 / max(np.abs(move[:-3]).max(), 1e-9))
            poses[k] += move[:-3].reshape(-1, 3)
            translations[k] += move[-3:]
    return Fitted(betas, poses, translations)


def surfaces(model: BodyModel, fitted: Fitted) -> list[Surface]:
    """The fitted body of every frame, body frame."""
    arrays = SkinningArrays.of(model)
    template, joints = shape_template(arrays, fitted.betas), joints_from_betas(arrays, fitted.betas)
    return [
        Surface(np.asarray(skin(arrays, template, joints, pose, move)), model.faces)
        for pose, move in zip(fitted.poses, fitted.translations, strict=True)
    ]


def errors_by_region(model: BodyModel, truth: Truth, fitted: Fitted) -> dict[str, tuple[float, float]]:
    """RMS and bias in mm of all scored vertices ('all') and of each region, over all frames."""
    return errors_of(truth, surfaces(model, fitted))


def errors_of(truth: Truth, found: list[Surface]) -> dict[str, tuple[float, float]]:
    """The same of any surfaces, one a frame, body frame."""
    signed, areas = [], []
    for vertices, surface in zip(in_body_frame(truth), found, strict=True):
        signed.append(signed_error_mm(vertices[truth.scored], surface))
        areas.append(vertex_areas(vertices, truth.faces)[truth.scored])
    error, area = np.stack(signed), np.stack(areas)
    region = truth.region[truth.scored]
    rows = {}
    for name in ("all", *SCORED_REGIONS):
        of = np.ones(len(region), dtype=bool) if name == "all" else region == name
        if of.any():
            summary = summarise(error[:, of].ravel(), area[:, of].ravel())
            rows[name] = (summary.rms, summary.bias)
    return rows


def freeform_surfaces(model: BodyModel, free: FreeForm) -> list[Surface]:
    """The free-form body of every frame, body frame."""
    arrays = SkinningArrays.of(model)
    return [
        Surface(np.asarray(skin(arrays, free.template, free.joints, pose, move)), model.faces)
        for pose, move in zip(free.poses, free.translations, strict=True)
    ]


def print_freeform(model: BodyModel, paths: list[Path]) -> None:
    """What the skinning leaves, a person a line: on all its frames, and on frames the template has not
    seen.
    """
    people: dict[str, list[Truth]] = {}
    for path in paths:
        people.setdefault(path.stem.split("_")[0], []).append(load_truth(path))
    print("\nwhat the skinning alone leaves: one free template a person, RMS (bias) mm")
    print(f"{'person':<16}{'frames':>11}" + "".join(f"{name:>14}" for name in ("all", *SCORED_REGIONS)))
    for name, sequences in people.items():
        starts = [pose for truth in sequences for pose in start_poses(model, truth)]
        vertices = np.concatenate([truth.vertices for truth in sequences])
        truth = replace(sequences[0], vertices=vertices, frame_ids=tuple(range(len(vertices))))
        start = fit_person(model, truth, starts)
        true = Points.of(in_body_frame(truth), truth.outer, truth.scored)
        at = (start.betas, start.poses, start.translations)
        _print_errors(
            name, f"{len(vertices)}", truth, freeform_surfaces(model, fit_freeform(model, true, *at))
        )
        halves = on_unseen_frames(model, true, *at)
        if halves is None:
            print(f"{name:<16}{'':>11}  one frame only: a free template meets it whatever the skinning does")
            continue
        found: list[Surface] = [Surface(np.zeros((0, 3)), model.faces)] * len(vertices)
        found[::2], found[1::2] = (freeform_surfaces(model, half) for half in halves)
        _print_errors(name, "not seen", truth, found)


def _print_errors(name: str, frames: str, truth: Truth, found: list[Surface]) -> None:
    cells = "".join(f"{rms:7.2f} {bias:+6.2f}" for rms, bias in errors_of(truth, found).values())
    print(f"{name:<16}{frames:>11}{cells}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of truth files, <sequence>.npz")
    parser.add_argument("--body", default="free:neutral")
    parser.add_argument("--components", type=int, nargs="*", default=None)
    parser.add_argument("--freeform", action="store_true", help="what the skinning alone leaves")
    options = parser.parse_args()
    model = load_body(options.body)
    counts = options.components or [10, model.n_anthropometric, model.n_betas]
    print(machine())
    print(f"{options.body}: best fit of pose and shape to naked people of another model, RMS (bias) mm")
    header = "".join(f"{name:>14}" for name in ("all", *SCORED_REGIONS))
    print(f"{'person':<16}{'components':>11}{header}{'largest beta':>14}")
    paths = sorted(options.folder.glob("*.npz"))
    for path in paths:
        truth = load_truth(path)
        starts = start_poses(model, truth)
        for n in counts:
            part = model.with_betas(n)
            fitted = fit_person(part, truth, starts)
            rows = errors_by_region(part, truth, fitted)
            cells = "".join(f"{rms:7.2f} {bias:+6.2f}" for rms, bias in rows.values())
            print(f"{path.stem:<16}{n:>11}{cells}{np.abs(fitted.betas).max():14.2f}", flush=True)
    if options.freeform:
        print_freeform(model, paths)


if __name__ == "__main__":
    main()
