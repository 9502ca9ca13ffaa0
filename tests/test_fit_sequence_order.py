"""Sequences: the surest frame first and both ways from it, resumed runs equal, lost bodies found again."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from fit import aligned_frames
from fit.align import Alignment, align_sequence
from fit.coarse import CoarsePose, CoarseScan
from fit.initialise import PoseFinder
from fit.lost import Signs, Step, Usual, complaints, is_fast
from fit.sequence_order import both_ways, doubt, surest_frame, tried_frames
from fit.settings import FitSettings
from fit.state import BodyState
from fit.surface import vertex_normals
from hull.scan import Scan
from tests.test_fit_pose_finding import finder, fitter

SETTINGS = FitSettings(n_points=3000, max_iterations=3)
N_FRAMES = 6
LEFT_ARM, LEFT_WRIST = (18, 20, 22), 20


@cache
def states() -> tuple[BodyState, ...]:
    """A person who turns a little, the left arm out to the side and coming down slowly."""
    betas = np.zeros(fitter().model.n_betas)
    out = []
    for k in range(N_FRAMES):
        pose = finder().mean_pose()
        pose[0] = [0.0, 0.1 * k, 0.0]
        pose[16] = [0.0, -0.1, 0.1 - 0.06 * k]
        pose[18] = [0.0, -0.3, 0.0]
        out.append(BodyState(fitter().shaped(betas), pose, np.array([0.02 * k, 0.9, 0.0]), betas))
    return tuple(out)


def scan_of(state: BodyState, without: tuple[int, ...] = ()) -> Scan:
    """The body's own vertices, some parts left out."""
    vertices = fitter().posed(state)
    kept = ~np.isin(fitter().model.parts, without)
    n = int(kept.sum())
    normals = vertex_normals(vertices, fitter().model.faces)
    return Scan(vertices[kept], normals[kept], None, np.zeros(n, dtype=bool), np.ones(n))


@cache
def frames() -> tuple[tuple[int, Scan, None], ...]:
    return tuple((10 + k, scan_of(state), None) for k, state in enumerate(states()))


@cache
def undisturbed() -> tuple[tuple[Alignment, ...], tuple[int, ...]]:
    """The alignments, and the numbers of the frames as they were reported."""
    order: list[int] = []
    done = align_sequence(fitter(), finder(), frames(), SETTINGS, lambda a: order.append(a.frame_id))
    return tuple(done), tuple(order)


def true_joints(k: int) -> np.ndarray:
    return fitter().posed_joints(states()[k], fitter().joints(states()[k].betas))


def joints_off(alignment: Alignment, k: int) -> np.ndarray:
    state = alignment.state
    return np.linalg.norm(fitter().posed_joints(state, fitter().joints(state.betas)) - true_joints(k), axis=1)


def test_from_the_surest_frame_to_the_end_then_to_the_beginning() -> None:
    done, order = undisturbed()
    first = order[0]
    assert list(order) == [*range(first, 10 + N_FRAMES), *range(first - 1, 9, -1)]
    assert [a.frame_id for a in done] == [frame_id for frame_id, _, _ in frames()], "results in time's order"
    for k, alignment in enumerate(done):
        assert alignment.status == "ok", alignment.message
        assert joints_off(alignment, k).max() < 0.06, f"{1e3 * joints_off(alignment, k).max():.0f} mm"


@pytest.mark.parametrize("missing", [(12, 15), (10, 14)])
def test_a_run_that_goes_on_gives_what_one_without_a_stop_gives(missing: tuple[int, ...]) -> None:
    done, _ = undisturbed()
    told: list[int] = []
    before = {a.frame_id: a for a in done if a.frame_id not in missing}
    again = align_sequence(fitter(), finder(), frames(), SETTINGS, lambda a: told.append(a.frame_id), before)
    assert sorted(told) == sorted(missing), "finished frames are not made again"
    for one, other in zip(again, done, strict=True):
        for name in ("template", "pose", "translation", "betas"):
            np.testing.assert_array_equal(getattr(one.state, name), getattr(other.state, name))
        assert (one.score, one.distance_m, one.status) == (other.score, other.distance_m, other.status)


def test_a_frame_that_started_wrong_is_started_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """The left arm of one frame starts behind the back, as if its neighbour had misled it."""
    usual_start = aligned_frames.starting_poses

    def misled(finder_: PoseFinder, coarse: CoarseScan, *rest: Any) -> list[CoarsePose]:
        starts = usual_start(finder_, coarse, *rest)
        if abs(coarse.points.mean(0)[0] - frames()[5][1].points.mean(0)[0]) < 0.01:
            pose = starts[0].pose.copy()
            pose[16], pose[18] = [0.0, 0.9, -1.2], [0.0, -1.2, 0.0]
            return [replace(starts[0], pose=pose)]
        return starts

    monkeypatch.setattr(aligned_frames, "starting_poses", misled)
    done = align_sequence(fitter(), finder(), frames(), SETTINGS)
    assert [a.status for a in done] == ["ok"] * N_FRAMES, [a.message for a in done]
    assert [a.tried for a in done] == [False] * 5 + [True]
    off = joints_off(done[5], 5)
    assert off.max() < 0.06, f"the worst joint is {1e3 * off.max():.0f} mm off"


def test_a_scan_without_an_arm_is_suspect_and_misleads_nobody() -> None:
    damaged = list(frames())
    damaged[4] = (14, scan_of(states()[4], without=LEFT_ARM), None)
    done = align_sequence(fitter(), finder(), damaged, SETTINGS)
    assert [a.status for a in done] == ["ok"] * 4 + ["suspect", "ok"], [a.message for a in done]
    assert done[4].message == "frame 000014: 3.3 % of the body stands out of the scan, 0.0 % is usual"
    assert done[4].tried and not done[4].lost, "the hull alone gave the same pose"
    for k in (3, 4, 5):
        assert joints_off(done[k], k)[LEFT_WRIST] < 0.06


def test_frames_that_are_tried_are_even_over_the_sequence() -> None:
    assert tried_frames(1) == [0]
    assert tried_frames(5) == [2]
    assert tried_frames(12) == [2, 6, 10]
    assert tried_frames(500) == [50, 150, 250, 350, 450]


def test_both_ways_meet_every_frame_once() -> None:
    for first in range(5):
        later, earlier = both_ways(5, first)
        assert later[0] == first
        assert sorted([*later, *earlier]) == list(range(5))


def test_doubt_falls_with_the_score_and_with_the_distance_of_the_next_heading() -> None:
    def facing(heading: float, score: float) -> CoarsePose:
        pose = np.zeros((24, 3))
        pose[0, 1] = heading
        return CoarsePose(pose, np.zeros(3), np.zeros(4), score)

    sure = doubt([facing(0.0, 0.03), facing(3.0, 0.045)])
    unsure = doubt([facing(0.0, 0.03), facing(3.0, 0.031)])
    assert sure == pytest.approx(0.03 / 1.25)
    assert unsure == pytest.approx(0.03 * 0.03 / 0.031)
    assert doubt([facing(0.0, 0.03), facing(0.1, 0.03)]) == pytest.approx(sure), "the same way, no rival"
    assert doubt([facing(0.0, 0.04)]) > sure


def test_the_best_of_the_tried_without_a_rival_is_the_surest(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve frames, three of them tried; a broken scan is passed over."""
    found = iter([[0.040], [0.030, 0.0305], [0.033]])

    def search(self: PoseFinder, scan: CoarseScan, betas: np.ndarray | None = None) -> list[CoarsePose]:
        poses = np.zeros((2, 24, 3))
        poses[1, 0, 1] = 3.0  # faces the other way
        return [CoarsePose(p, np.zeros(3), np.zeros(4), s) for p, s in zip(poses, next(found), strict=False)]

    monkeypatch.setattr(PoseFinder, "search", search)
    broken = replace(frames()[0][1], points=np.full_like(frames()[0][1].points, np.nan))
    many = [(0, broken, None), *((k, frames()[k % 2][1], None) for k in range(1, 13))]
    first = surest_frame(finder(), many)
    assert first.frame_idx == 1 + tried_frames(12)[2]
    assert len(first.hypotheses) == 1


# What counts as lost


def signs(distance_m: float = 0.03, left_out: float = 0.002, outside: float = 0.001) -> Signs:
    return Signs(distance_m, left_out, outside, np.zeros((24, 3)))


def usual(n: int = 6, step_m: float = 0.1) -> Usual:
    wobble = np.linspace(-1.0, 1.0, n)
    return Usual.of([signs(0.03 + 0.0005 * w) for w in wobble], [step_m] * (n - 1))


def test_nothing_is_said_of_a_usual_frame() -> None:
    assert complaints(signs(), Step(0.2, "head", 3), usual()) == ()
    assert complaints(signs(0.033, 0.02, 0.02), None, usual()) == (), "poses differ"


def test_each_sign_has_its_sentence() -> None:
    assert complaints(signs(0.052), None, usual()) == ("the body keeps 52 mm from the scan, 30 mm is usual",)
    assert complaints(signs(left_out=0.042), None, usual()) == (
        "4.2 % of the scan is far from the body, 0.2 % is usual: a limb may be left out",
    )
    assert complaints(signs(outside=0.05), None, usual()) == (
        "5.0 % of the body stands out of the scan, 0.1 % is usual",
    )
    assert complaints(signs(), Step(0.83, "left wrist", 12), usual()) == (
        "the left wrist moved 0.83 m a frame from 000012, 0.10 m is usual",
    )


def test_what_is_usual_needs_frames_and_a_metre_is_always_far() -> None:
    assert complaints(signs(0.052), None, usual(n=3)) == ()
    assert not is_fast(Step(0.83, "left wrist", 12), usual(n=3))
    assert complaints(signs(), Step(1.2, "left wrist", 12), usual(n=3)) == (
        "the left wrist moved 1.20 m a frame from 000012",
    )
    assert is_fast(Step(1.2, "left wrist", 12), usual(step_m=0.5))
    assert not is_fast(Step(0.24, "left wrist", 12), usual(step_m=0.01)), "a hand may do that"


def test_what_the_trusted_neighbour_has_too_is_no_sign() -> None:
    carries_a_bag = signs(left_out=0.05)
    assert complaints(carries_a_bag, None, usual(), neighbour=signs(left_out=0.045)) == ()
    assert len(complaints(carries_a_bag, None, usual(), neighbour=signs())) == 1


def test_a_step_is_measured_a_frame() -> None:
    there = np.zeros((24, 3))
    there[20, 0] = 0.6
    step = Step.between(there, np.zeros((24, 3)), 4, 3.0)
    assert (round(step.metres, 9), step.joint, step.since_id) == (0.2, "left wrist", 4)
