"""Noise as it was asked for: outlines and cameras err by the pixels that were given."""

import cv2
import numpy as np
import pytest

from capture.layouts import ring_layout
from render.spoil import misplaced_rig, wandering_outline


def disc(radius: float, size: int = 400) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    return np.where(np.hypot(rows, columns) <= radius, 255, 0).astype(np.uint8)


@pytest.mark.parametrize("sigma_px", [1.0, 3.0])
def test_an_outline_wanders_by_its_standard_deviation_and_keeps_its_area(sigma_px: float) -> None:
    masks = [wandering_outline(disc(120), sigma_px, np.random.default_rng(seed)) for seed in range(6)]
    radii = []
    for mask in masks:
        assert set(np.unique(mask)) == {0, 255}
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outline = max(contours, key=len).reshape(-1, 2) - 199.5
        radii.append(np.hypot(*outline.T))
    off = np.concatenate(radii) - np.concatenate([r.mean() + 0 * r for r in radii])
    assert 0.75 * sigma_px < off.std() < 1.3 * sigma_px
    areas = np.array([(mask > 0).sum() for mask in masks])
    assert abs(areas.mean() / (disc(120) > 0).sum() - 1) < 0.01


def test_no_noise_changes_nothing_and_a_cut_person_stays_cut() -> None:
    rng = np.random.default_rng(0)
    assert wandering_outline(disc(80), 0.0, rng) is not None
    assert (wandering_outline(disc(80), 0.0, rng) == disc(80)).all()
    empty = np.zeros((50, 60), np.uint8)
    assert not wandering_outline(empty, 2.0, rng).any()
    cut = np.zeros((200, 200), np.uint8)
    cut[:, 60:140] = 255
    moved = wandering_outline(cut, 2.0, rng)
    assert (moved[0, 75:125] == 255).all()
    assert (moved[-1, 75:125] == 255).all()


def test_cameras_err_by_the_pixels_asked_for_and_alike_at_every_size() -> None:
    rig = ring_layout(200, (800, 600))
    points = np.array([[0.0, 0.0, 1.1]])
    shifts = {}
    for sigma in (0.5, 2.0):
        off = misplaced_rig(rig, sigma, seed=3)
        shifts[sigma] = np.array(
            [(b.project(points)[0] - a.project(points)[0])[0] for a, b in zip(rig, off, strict=True)]
        )
        assert 0.85 * sigma < shifts[sigma].std() < 1.15 * sigma
        assert all(np.abs(a.centre - b.centre).max() < 1e-9 for a, b in zip(rig, off, strict=True)), (
            "a camera is turned about its centre"
        )
    assert np.abs(shifts[2.0] - 4 * shifts[0.5]).max() < 0.05
    still = misplaced_rig(rig, 0.0, seed=3)
    assert np.abs(still[0].project(points)[0] - rig[0].project(points)[0]).max() < 1e-9
