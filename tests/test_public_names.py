"""The names and parameters that programs of others may rely on: a change here is a change for them."""

import importlib
import inspect

import pytest

FUNCTIONS = {
    "capture.recording.open_recording": "path sequence calibration frames units up background",
    "capture.layouts.dome_layout": "n_cameras size",
    "capture.layouts.ring_layout": "n_cameras size",
    "capture.layouts.cage_layout": "n_cameras size",
    "capture.keypoints.read_keypoints": "folder camera_names frame_id",
    "capture.keypoints.triangulate_keypoints": "rig per_camera silhouettes",
    "capture.rig_formats.detect_format": "path",
    "capture.rig_formats.read_rig_of": "path",
    "capture.rig_formats.write_rig": "rig path format_name overwrite",
    "capture.convention.settle_convention": "rig frames",
    "capture.board_calibration.calibrate": "sightings board known wide",
    "capture.world_frame.settle_ground": "rig floor joints masks height_m",
    "capture.lens_file.save_lenses": "path lenses",
    "capture.lens_file.load_lenses": "path",
    "capture.keypoints.chosen_detections": "rig per_camera silhouettes",
    "capture.rig_adjustment.adjusted": "given terms free settings focal start",
    "hull.outlines.outline_of": "mask",
    "hull.rig_consistency.agreement_with_others": "rig images use voxel_m",
    "hull.rig_refinement.refine_pose": "rig evidence focal",
    "hull.bounds.find_bounds": "rig images",
    "hull.visual_hull.build_hull": "rig images voxel_m bounds",
    "hull.quality.silhouette_agreement": "vertices faces rig images",
    "hull.mesh_file.save_mesh": "path vertices faces normals",
    "hull.mesh_file.load_mesh": "path",
    "hull.hull_file.save_hull": "path hull",
    "hull.colours.vertex_colours": "vertices faces normals cameras picture_of",
    "hull.quality.contour_distance": "vertices faces rig images",
    "hull.hull_file.load_hull": "path",
    "fit.body.load_body": "spec",
    "fit.body.body_file.read_body_file": "path",
    "fit.frames.recording_from_body": "up",
    "fit.truth.load_truth": "path sequence",
    "render.video.write_video": "path frames fps",
    "render.report.write_report": "path data",
    "render.subject.make_subject": "body seed garment",
    "render.synthetic.film": "out body n_cameras size layout n_frames motion garment seed",
    "bodyhull.carving.carve_stage": "config",
    "bodyhull.fitting.fit_stage": "config settings",
    "bodyhull.drawing.draw_stage": "config",
    "bodyhull.evaluating.evaluate_stage": "config truth_path",
    "bodyhull.cli.main": "arguments",
}
FIELDS = {
    "capture.camera.Camera": "name size intrinsics camera_from_world distortion projection",
    "capture.rig.Rig": "cameras",
    "capture.board.Board": "kind columns rows square_m marker_m dictionary legacy",
    "capture.board_view.BoardView": "ids pixels edge_px",
    "capture.board_view.Sightings": "names sizes views alone labels",
    "capture.world_frame.Ground": "rig world_from_before scale notes doubts",
    "capture.recording.Recording": "name rig calibration frame_ids up unit metres_per_unit notes",
    "capture.recording.Silhouettes": "frame_id images problems",
    "hull.rig_refinement.Evidence": "outlines people",
    "hull.rig_refinement.Refinement": "pose moved left",
    "hull.bounds.Bounds": "low high",
    "hull.visual_hull.Hull": "vertices faces normals n_witnesses n_bounding cut_by slack_m "
    "is_phantom colours",
    "hull.scan.Scan": "points normals faces is_skin weight",
    "fit.body.BodyModel": "name licence template faces shape_directions pose_directions weights "
    "joint_regressor parents parts landmarks n_anthropometric kind gender notes",
    "fit.body.body_file.BodyFile": "name licence kind gender template faces shape_directions "
    "expression_directions pose_directions weights joint_regressor parents parts landmarks",
    "fit.state.BodyState": "template pose translation betas",
    "fit.align.Alignment": "frame_id state score distance_m status message",
    "fit.fuse.FusionShape": "template betas joints spread fit_scale",
    "fit.track.TrackedFrame": "frame_id state distance_m status message",
    "fit.body.pose_prior.PosePrior": "mean covariance",
    "render.report.ReportData": "title subtitle headline problems facts facts_title pictures tables "
    "sheet_headers sheet films",
    "bodyhull.config.RunConfig": "recording out sequence body calibration frames voxel_mm units up "
    "background keypoints overwrite pose_prior colours",
}
METHODS = {
    "capture.camera.Camera": "project unproject rays pinhole undistort_image with_world_scaled "
    "projection_matrix centre",
    "capture.rig.Rig": "names save load with_world_scaled pinholes",
    "capture.recording.Recording": "silhouettes picture fingerprint",
    "hull.scan.Scan": "from_hull",
    "hull.visual_hull.Hull": "of_mesh volume_m3 problems",
    "fit.body.BodyModel": "content_hash save load of_file as_file shaped with_betas",
    "fit.body.body_file.BodyFile": "save",
}


def find(dotted: str) -> object:
    module, _, name = dotted.rpartition(".")
    return getattr(importlib.import_module(module), name)


@pytest.mark.parametrize("dotted", FUNCTIONS)
def test_functions_keep_their_first_parameters(dotted: str) -> None:
    wanted = FUNCTIONS[dotted].split()
    parameters = inspect.signature(find(dotted)).parameters  # type: ignore[arg-type]
    assert list(parameters)[: len(wanted)] == wanted
    added = list(parameters.values())[len(wanted) :]
    assert all(p.default is not p.empty or p.kind is p.VAR_KEYWORD for p in added), (
        "an addition must be optional"
    )


@pytest.mark.parametrize("dotted", FIELDS)
def test_types_keep_their_fields_and_stay_frozen(dotted: str) -> None:
    wanted, found = FIELDS[dotted].split(), find(dotted)
    assert list(found.__dataclass_fields__)[: len(wanted)] == wanted  # type: ignore[attr-defined]
    assert found.__dataclass_params__.frozen  # type: ignore[attr-defined]


@pytest.mark.parametrize("dotted", METHODS)
def test_types_keep_their_methods(dotted: str) -> None:
    found = find(dotted)
    assert [name for name in METHODS[dotted].split() if not hasattr(found, name)] == []


def test_errors_of_users_are_told_apart() -> None:
    """Each room's own error is what the command turns into one line; none of them hides another."""
    errors = [
        find(name)
        for name in (
            "capture.recording.RecordingError", "hull.errors.HullError", "hull.mesh_file.MeshFileError",
            "fit.body.BodyModelError", "fit.truth.TruthError", "bodyhull.errors.UserError",
            "render.gl.GlError", "render.synthetic.SyntheticError",
        )
    ]  # fmt: skip
    for error in errors:
        assert issubclass(error, Exception) and not any(
            issubclass(error, other) for other in errors if other != error
        )
