"""What `run` leaves behind: the files that other programs rely on, with their shapes, frames and units."""

import html
import json
import re
from pathlib import Path

import av
import numpy as np
import pytest

from bodyhull.config import RunConfig
from bodyhull.folder import RunFolder, load_arrays
from capture.rig import Rig
from fit.body.model import load_body
from fit.body.skeleton import axis_angle_to_matrix
from fit.closest import closest_points
from fit.frames import apply
from hull.hull_file import load_hull
from hull.mesh_file import load_mesh
from tests.command_line import call
from tests.tiny_run import BLIND, DEGRADED, FAILED, GOOD, N_CAMERAS, SIZE, VOXEL_MM, TinyRun

FITTED = (*GOOD, DEGRADED)
CAMERAS = [f"cam-{k:03d}" for k in range(N_CAMERAS)]


def state(tiny: TinyRun) -> dict:
    return json.loads((tiny.config.out / "run.json").read_text())


def track(tiny: TinyRun) -> dict[str, np.ndarray]:
    found = load_arrays(tiny.folder.track)
    assert found is not None
    return found


def test_the_files_that_other_programs_rely_on(tiny: TinyRun) -> None:
    wanted = {"run.json", "capture/rig.json", "fit/fusion.ply", "fit/fusion.npz", "fit/track.npz"}
    wanted |= {f"hull/{k:06d}.{kind}" for k in FITTED for kind in ("ply", "npz")}
    wanted |= {f"fit/meshes/{k:06d}.ply" for k in FITTED}
    wanted |= {f"fit/alignments/{k:06d}.npz" for k in FITTED}
    wanted |= {f"render/overlay/{name}.mp4" for name in CAMERAS} | {"render/report.html"}
    assert set(tiny.times()) == wanted


def test_hulls_carry_the_colours_of_the_pictures_unless_told_not_to(
    tiny: TinyRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hull = load_hull(tiny.folder.hull(GOOD[0]))
    assert hull.colours is not None and hull.colours.std(axis=0).min() > 5
    said = call(
        capsys,
        "carve",
        tiny.recording,
        "--out",
        tmp_path,
        "--voxel-mm",
        30,
        "--frames",
        "0:1",
        "--no-colours",
    )
    assert said.code == 0, said.err
    assert load_hull(RunFolder(tmp_path).hull(0)).colours is None


def test_a_failed_frame_is_kept_marked_and_does_not_stop_the_others(tiny: TinyRun) -> None:
    assert tiny.code == 3
    hull, fit = (state(tiny)["stages"][name]["frames"] for name in ("hull", "fit"))
    assert [hull[f"{k:06d}"]["status"] for k in range(4)] == ["ok", "ok", "degraded", "failed"]
    assert [fit[f"{k:06d}"]["status"] for k in range(4)] == ["ok", "ok", "ok", "failed"]
    sentence = hull[f"{FAILED:06d}"]["problems"][-1]
    assert sentence.startswith(f"frame {FAILED:06d}: ")
    assert fit[f"{FAILED:06d}"]["problems"] == [sentence]
    assert "silhouette is empty" in hull[f"{FAILED:06d}"]["problems"][0]
    found = track(tiny)
    assert found["status"].tolist() == ["ok", "ok", "ok", "failed"]
    assert found["message"][FAILED] == sentence
    assert np.isnan(found["pose"][FAILED]).all() and np.isfinite(found["pose"][list(FITTED)]).all()


def test_a_frame_without_one_camera_is_marked_degraded(tiny: TinyRun) -> None:
    entry = state(tiny)["stages"]["hull"]["frames"][f"{DEGRADED:06d}"]
    assert entry["problems"][0].startswith(
        f"Camera cam-{BLIND:03d}, frame {DEGRADED:06d}: frame missing in this"
    )
    assert entry["agreement"][BLIND] is None
    assert all(v is not None for k, v in enumerate(entry["agreement"]) if k != BLIND)


def test_the_track_has_the_documented_shapes(tiny: TinyRun) -> None:
    found = track(tiny)
    n_betas = len(found["betas"])
    shapes = {
        "frame_ids": (4,), "pose": (4, 24, 3), "translation": (4, 3), "betas": (n_betas,), "joints": (24, 3),
        "templates": (4, 6890, 3), "status": (4,), "message": (4,), "distance_m": (4,),
        "recording_from_body": (4, 4), "faces": (13776, 3), "body": (), "body_hash": (),
    }  # fmt: skip
    assert {name: found[name].shape for name in shapes} == shapes
    assert n_betas >= 10
    rotation = found["recording_from_body"][:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(
        rotation @ [0, 1, 0], [0, 0, 1], atol=1e-12
    )  # y of the body is z of this recording


def test_meshes_are_the_track_skinned_in_the_recordings_world(tiny: TinyRun) -> None:
    """As another program would do it, from the track and the body alone (SMPL, equations 2 to 4 and 9)."""
    found, model = track(tiny), load_body("free:neutral", show_progress=False)
    for k in FITTED:
        turns = axis_angle_to_matrix(found["pose"][k])
        correctives = model.pose_directions @ (turns[1:] - np.eye(3)).ravel()
        world = np.tile(np.eye(4), (24, 1, 1))
        for joint, parent in enumerate(model.parents):
            local = np.eye(4)
            local[:3, :3] = turns[joint]
            local[:3, 3] = found["joints"][joint] - (found["joints"][parent] if joint else 0.0)
            world[joint] = world[parent] @ local if joint else local
        world[:, :3, 3] -= np.einsum("jab,jb->ja", world[:, :3, :3], found["joints"])
        blended = np.einsum("vj,jab->vab", model.weights, world)
        unposed = found["templates"][k] + correctives
        posed = (
            np.einsum("vab,vb->va", blended[:, :3, :3], unposed) + blended[:, :3, 3] + found["translation"][k]
        )
        vertices, faces = load_mesh(tiny.folder.mesh(k))
        np.testing.assert_allclose(vertices, apply(found["recording_from_body"], posed), atol=1e-6)
        np.testing.assert_array_equal(faces, model.faces)


def test_the_fusion_shape_is_upright_in_the_recordings_world(tiny: TinyRun) -> None:
    vertices, faces = load_mesh(tiny.folder.fusion_mesh)
    arrays = load_arrays(tiny.folder.fusion)
    assert arrays is not None and vertices.shape == (6890, 3) and faces.shape == (13776, 3)
    np.testing.assert_allclose(
        vertices, apply(track(tiny)["recording_from_body"], arrays["template"]), atol=1e-12
    )
    extent = np.ptp(vertices, axis=0)
    assert 1.4 < extent[2] < 2.1, f"the person is {extent[2]:.2f} m tall along the recording's up axis"
    assert 1.3 < extent[0] < 2.2, f"arms of the zero pose span {extent[0]:.2f} m along x"


def test_the_body_lies_in_the_hull_and_near_the_truth(tiny: TinyRun) -> None:
    with np.load(tiny.truth / "truth.npz") as data:
        true = data["vertices"].astype(float)
    for k in FITTED:
        vertices, _ = load_mesh(tiny.folder.mesh(k))
        hull = load_mesh(tiny.folder.hull(k))
        outside = (closest_points(*hull, vertices).distance > 0.005).mean()
        assert outside < 0.02, f"frame {k}: {100 * outside:.1f} % of the body lies outside its hull"
        # The same vertex on the same limb: a mirrored or turned body is tens of centimetres off.
        off = np.linalg.norm(vertices - true[k], axis=1)
        assert np.median(off) < 0.04 and np.quantile(off, 0.95) < 0.12, (
            f"frame {k}: {np.quantile(off, [0.5, 0.95])}"
        )


def test_the_cameras_of_the_run_are_those_of_the_recording(tiny: TinyRun) -> None:
    rig = Rig.load(tiny.folder.rig_file)
    assert list(rig.names) == CAMERAS
    assert all(camera.size == (SIZE, SIZE) and len(camera.distortion) == 0 for camera in rig)


def test_every_camera_has_a_film_that_opens(tiny: TinyRun) -> None:
    for name in CAMERAS:
        with av.open(str(tiny.folder.overlay(name))) as film:
            stream = film.streams.video[0]
            assert stream.codec_context.name == "h264" and stream.codec_context.pix_fmt == "yuv420p"
            pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
        assert len(pictures) == len(FITTED)
        assert all(np.ptp(picture) > 100 for picture in pictures), "a film shows something"


def test_the_body_covers_the_person_in_every_camera(tiny: TinyRun) -> None:
    agreement = state(tiny)["stages"]["render"]["agreement"]
    assert set(agreement) == set(CAMERAS)
    assert agreement[f"cam-{BLIND:03d}"][FITTED.index(DEGRADED)] is None
    values = [v for scores in agreement.values() for v in scores if v is not None]
    assert min(values) > 0.6 and np.median(values) > 0.75, f"IoU {min(values):.2f} to {max(values):.2f}"


def test_the_report_needs_no_network_and_tells_of_the_failed_frame(tiny: TinyRun) -> None:
    page = tiny.folder.report.read_text()
    assert not re.findall(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", page)
    assert "<script src" not in page and "@import" not in page and "<link" not in page
    assert page.count("data:image/") >= 3 * 4 * 4
    assert f"frame {FAILED:06d}: " in page
    assert f"Camera cam-{BLIND:03d}, frame {DEGRADED:06d}" in page


def test_run_json_tells_how_the_run_was_made(tiny: TinyRun) -> None:
    found = state(tiny)
    assert RunConfig.from_dict(found["configuration"]) == tiny.config
    assert found["configuration"]["voxel_mm"] == VOXEL_MM
    assert len(found["inputs"]["fingerprint"]) == 64
    assert found["recording"]["frame_ids"] == [0, 1, 2, 3] and found["recording"]["cameras"] == CAMERAS
    assert {"bodyhull", "python", "numpy", "jax", "open3d"} <= set(found["software"])
    assert set(found["stages"]) == {"hull", "fit", "render"}
    json.dumps(found, allow_nan=False)


def test_the_report_names_the_frame_of_every_problem(tiny: TinyRun) -> None:
    page = html.unescape(tiny.folder.report.read_text("utf-8"))
    frames = tiny.folder.read_state()["stages"]["hull"]["frames"]
    told = [(name, problem) for name, entry in frames.items() for problem in entry["problems"]]
    assert told
    for name, problem in told:
        assert (problem if f"frame {name}" in problem else f"frame {name}: {problem}") in page
