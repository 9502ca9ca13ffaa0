"""Every format against its own program's or documentation's way of projecting, in files made here by hand."""

import json
import pickle
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from capture.camera import Camera
from capture.errors import RecordingError
from capture.rig import Rig
from capture.rig_formats import FORMATS, detect_format, read_rig_of, write_rig
from tests.rigs_for_formats import awkward_rig, seen_points, worst_px


def by_opencv(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Pixels by cv2.projectPoints: the project's camera is not asked."""
    rotation, translation = camera.camera_from_world[:3, :3].copy(), camera.camera_from_world[:3, 3].copy()
    lens = camera.distortion if camera.distortion.size else np.zeros(4)
    pixels = cv2.projectPoints(
        points, cv2.Rodrigues(rotation)[0], translation, camera.intrinsics.copy(), lens
    )[0]
    return pixels.reshape(-1, 2)


def agrees(path: Path, rig: Rig, metres_per_unit: float = 1.0) -> None:
    found = read_rig_of(path)
    sizes = dict(zip(found.names, [camera.size for camera in rig], strict=True))
    points = seen_points(rig)
    for given, read in zip(rig, found.with_sizes(sizes.get).rig(), strict=True):
        pixels, depth = read.project(points / metres_per_unit)
        assert np.abs(pixels - by_opencv(given, points)).max() < 1e-6
        assert (depth > 0).all()


def texts(values: np.ndarray) -> str:
    return ", ".join(repr(float(v)) for v in np.ravel(values))


def test_colmap_counts_pixels_from_the_corner(tmp_path: Path) -> None:
    """pycolmap's own projection, half a pixel off ours, for every camera model that is read."""
    lenses = {
        "SIMPLE_PINHOLE": (500.0, 320.25, 239.5),
        "PINHOLE": (500.0, 510.0, 320.25, 239.5),
        "SIMPLE_RADIAL": (500.0, 320.25, 239.5, -0.08),
        "RADIAL": (500.0, 320.25, 239.5, -0.08, 0.02),
        "OPENCV": (500.0, 510.0, 320.25, 239.5, -0.08, 0.02, 1e-3, -2e-3),
        "FULL_OPENCV": (500.0, 510.0, 320.25, 239.5, -0.08, 0.02, 1e-3, -2e-3, 0.01, 0.02, -0.01, 0.003),
    }
    rig = awkward_rig(n_cameras=len(lenses))
    model = pycolmap.Reconstruction()
    for k, (name, parameters) in enumerate(lenses.items()):
        camera = pycolmap.Camera(model=name, width=640, height=480, params=parameters, camera_id=k + 1)
        model.add_camera_with_trivial_rig(camera)
        pose = rig[k].camera_from_world
        image = pycolmap.Image(name=f"{name}.jpg", camera_id=k + 1, image_id=k + 1)
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3].copy()), pose[:3, 3].copy())
        )
    points = seen_points(rig)
    for text in (False, True):
        folder = tmp_path / str(text)
        folder.mkdir()
        (model.write_text if text else model.write_binary)(str(folder))
        found = read_rig_of(folder).rig()
        assert found.names == tuple(lenses)
        for image_id in model.images:
            image = model.images[image_id]
            theirs = np.array([image.project_point(point) for point in points])
            ours = found[found.names.index(image.name.removesuffix(".jpg"))].project(points)[0]
            assert np.abs(ours + 0.5 - theirs).max() < 1e-6
    written = tmp_path / "written"
    write_rig(awkward_rig(8), written, "colmap")
    back = pycolmap.Reconstruction(str(written))
    assert (back.num_rigs(), back.num_frames(), back.num_cameras()) == (1, 1, 4)
    for image in back.images.values():
        camera = awkward_rig(8)[image.image_id - 1]
        theirs = np.array([image.project_point(point) for point in points])
        assert np.abs(theirs - 0.5 - by_opencv(camera, points)).max() < 1e-6


def test_an_old_colmap_model_has_no_rigs_and_perhaps_no_points(tmp_path: Path) -> None:
    rig = awkward_rig(4)
    write_rig(rig, tmp_path / "sparse" / "0", "colmap")
    for part in ("rigs", "frames", "points3D"):
        (tmp_path / "sparse" / "0" / f"{part}.bin").unlink()
    agrees(tmp_path, rig)
    assert detect_format(tmp_path / "sparse" / "0" / "images.bin") == "colmap"


@pytest.mark.parametrize("moving", [False, True])
def test_colmap_frames_of_one_rig_are_one_camera_each(tmp_path: Path, moving: bool) -> None:
    rig = awkward_rig(n_cameras=3)
    model, colmap_rig = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1)

    def rigid(pose: np.ndarray) -> pycolmap.Rigid3d:
        return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3].copy()), pose[:3, 3].copy())

    for k, camera in enumerate(rig):
        m = camera.intrinsics
        made = pycolmap.Camera(
            model="PINHOLE",
            width=camera.size[0],
            height=camera.size[1],
            params=[m[0, 0], m[1, 1], m[0, 2] + 0.5, m[1, 2] + 0.5],
            camera_id=k + 1,
        )
        model.add_camera(made)
        if k == 0:
            colmap_rig.add_ref_sensor(made.sensor_id)
        else:
            pose = camera.camera_from_world @ np.linalg.inv(rig[0].camera_from_world)
            colmap_rig.add_sensor(made.sensor_id, rigid(pose))
    model.add_rig(colmap_rig)
    board = np.eye(4)
    for frame_id in (1, 2):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        images = [
            pycolmap.Image(name=f"{c.name}/{frame_id:06d}.png", camera_id=k + 1, image_id=10 * frame_id + k)
            for k, c in enumerate(rig)
        ]
        for image in images:
            image.frame_id = frame_id
            frame.add_data_id(image.data_id)
        board[:3, 3] = (0.3, 0.2, 0.1) if moving and frame_id == 2 else 0
        frame.rig_from_world = rigid(rig[0].camera_from_world @ board)
        model.add_frame(frame)
        for image in images:
            model.add_image(image)
        model.register_frame(frame_id)
    model.write_binary(str(tmp_path))
    found = read_rig_of(tmp_path)
    assert found.names == rig.names
    if not moving:
        assert worst_px(rig, found.rig()) < 1e-6 and not found.notes
        return
    assert "its cameras are given in the rig's own frame" in found.notes[0]
    relative = found.rig()[2].camera_from_world @ np.linalg.inv(found.rig()[0].camera_from_world)
    expected = rig[2].camera_from_world @ np.linalg.inv(rig[0].camera_from_world)
    assert np.abs(relative - expected).max() < 1e-9


def test_easymocap_as_its_own_writer_leaves_it(tmp_path: Path) -> None:
    """Six decimals, CRLF, no sizes: read to what six decimals are worth; the names keep their zeros."""
    rig = awkward_rig(5)
    intri, extri = ["%YAML:1.0", "---", "names:"], ["%YAML:1.0", "---", "names:"]
    for lines in (intri, extri):
        lines += [f'  - "{k:02d}"' for k in range(4)]

    def matrix(key: str, values: np.ndarray) -> list[str]:
        data = ", ".join(f"{v:.6f}" for v in values.ravel())
        return [
            f"{key}: !!opencv-matrix", f"  rows: {len(values)}", f"  cols: {values.shape[1]}", "  dt: d",
            f"  data: [{data}]",
        ]  # fmt: skip

    for k, camera in enumerate(rig):
        rotation = camera.camera_from_world[:3, :3].copy()
        intri += matrix(f"K_{k:02d}", camera.intrinsics) + matrix(f"dist_{k:02d}", camera.distortion[None])
        extri += matrix(f"R_{k:02d}", cv2.Rodrigues(rotation)[0]) + matrix(f"Rot_{k:02d}", rotation)
        extri += matrix(f"T_{k:02d}", camera.camera_from_world[:3, 3:])
    for file, lines in (("intri.yml", intri), ("extri.yml", extri)):
        (tmp_path / file).write_bytes("\r\n".join([*lines, ""]).encode())
    found = read_rig_of(tmp_path)
    assert (found.names, found.unit) == (("00", "01", "02", "03"), "m")
    assert all(camera.size is None for camera in found.cameras)
    sizes = dict(zip(found.names, [camera.size for camera in rig], strict=True))
    assert worst_px(rig, found.with_sizes(sizes.get).rig()) < 5e-3
    folder = tmp_path / "images" / "02"
    folder.mkdir(parents=True)
    cv2.imwrite(str(folder / "000000.png"), np.zeros((480, 640), np.uint8))
    assert read_rig_of(tmp_path / "extri.yml").cameras[2].size == (640, 480), "a picture tells the size"
    text = (tmp_path / "extri.yml").read_text().replace("R_01:", "Rx_01:").replace("Rot_01:", "Rotx_01:")
    (tmp_path / "extri.yml").write_text(text)
    with pytest.raises(RecordingError, match=r"extri\.yml: camera 01 .* R_01 and Rot_01 is missing here"):
        read_rig_of(tmp_path)
    (tmp_path / "extri.yml").unlink()
    with pytest.raises(RecordingError, match=r"EasyMocap needs both intri\.yml and extri\.yml"):
        read_rig_of(tmp_path / "intri.yml")


def test_easymocap_takes_what_is_written_for_it(tmp_path: Path) -> None:
    """Through OpenCV's own parser, by the keys that EasyMocap reads."""
    rig = awkward_rig(5)
    write_rig(rig, tmp_path, "easymocap")
    intri = cv2.FileStorage(str(tmp_path / "intri.yml"), cv2.FILE_STORAGE_READ)
    extri = cv2.FileStorage(str(tmp_path / "extri.yml"), cv2.FILE_STORAGE_READ)
    names = intri.getNode("names")
    points = seen_points(rig)
    for k, camera in enumerate(rig):
        name = names.at(k).string()
        vector, moved = extri.getNode(f"R_{name}").mat(), extri.getNode(f"T_{name}").mat()
        matrix, lens = intri.getNode(f"K_{name}").mat(), intri.getNode(f"dist_{name}").mat()
        assert (vector.shape, moved.shape, lens.shape) == ((3, 1), (3, 1), (1, 5))
        pixels = cv2.projectPoints(points, vector, moved, matrix, lens)[0].reshape(-1, 2)
        assert np.abs(pixels - camera.project(points)[0]).max() < 1e-6
        assert np.abs(cv2.Rodrigues(vector)[0] - extri.getNode(f"Rot_{name}").mat()).max() < 1e-12
        size = int(intri.getNode(f"W_{name}").real()), int(intri.getNode(f"H_{name}").real())
        assert size == camera.size


def toml(camera: Camera, rotation: str, n_lens: int, scale: float = 1.0) -> str:
    rows = ", ".join(f"[ {texts(row)} ]" for row in camera.intrinsics)
    lens = np.zeros(n_lens)
    lens[: camera.distortion.size] = camera.distortion
    return (
        f"matrix = [ {rows} ]\ndistortions = [ {texts(lens)} ]\nrotation = {rotation}\n"
        f"translation = [ {texts(scale * camera.camera_from_world[:3, 3])} ]\n"
    )


def test_the_three_tomls_and_their_units(tmp_path: Path) -> None:
    rig = awkward_rig(4)
    vectors = [cv2.Rodrigues(c.camera_from_world[:3, :3].copy())[0] for c in rig]
    rotations = [f"[ {texts(vector)} ]" for vector in vectors]
    anipose = "".join(
        f'[cam_{k}]\nname = "{c.name}"\nsize = [ {c.size[0]}, {c.size[1]},]\n{toml(c, r, 5, 1000)}\n'
        for k, (c, r) in enumerate(zip(rig, rotations, strict=True))
    )
    (tmp_path / "anipose.toml").write_text(anipose + "[metadata]\nadjusted = true\nerror = 0.4\n")
    pose2sim = "".join(
        f'[{c.name}]\nname = "{c.name}"\nsize = [ {c.size[0]}.0, {c.size[1]}.0]\n'
        f"{toml(c, r, 4)}fisheye = false\n"
        for c, r in zip(rig, rotations, strict=True)
    )
    (tmp_path / "pose2sim.toml").write_text(pose2sim + "[metadata]\nadjusted = false\nerror = 0.0\n")
    # The older kind of rotation, an ignored camera, and one without a pose.
    matrices = [
        "[ " + ", ".join(f"[ {texts(row)} ]" for row in c.camera_from_world[:3, :3]) + " ]" for c in rig
    ]
    caliscope = "".join(
        f"[cameras.{k}]\ncam_id = {k}\nsize = [ {c.size[0]}, {c.size[1]} ]\nignore = false\n{toml(c, r, 5)}"
        for k, (c, r) in enumerate(zip(rig, matrices, strict=True))
    )
    caliscope += f"[cameras.8]\ncam_id = 8\nsize = [ 9, 9 ]\nignore = true\n{toml(rig[0], rotations[0], 5)}"
    (tmp_path / "caliscope.toml").write_text(caliscope + "[cameras.9]\ncam_id = 9\nsize = [ 640, 480 ]\n")
    units = {"anipose": (None, 1e-3), "pose2sim": ("m", 1.0), "caliscope": ("m", 1.0)}
    for name, (unit, metres) in units.items():
        assert read_rig_of(tmp_path / f"{name}.toml").unit == unit, name
        agrees(tmp_path / f"{name}.toml", rig, metres)
    notes = read_rig_of(tmp_path / "caliscope.toml").notes
    assert "left out: cam_8, cam_9" in notes[0]
    with pytest.raises(
        RecordingError, match=r"several calibrations \(anipose.toml, caliscope.toml, pose2sim.toml"
    ):
        detect_format(tmp_path)
    (tmp_path / "fish.toml").write_text(pose2sim.replace("fisheye = false", "fisheye = true"))
    with pytest.raises(RecordingError, match="camera cam-000 has a fisheye lens"):
        read_rig_of(tmp_path / "fish.toml")
    (tmp_path / "half.toml").write_text(pose2sim[:300])
    with pytest.raises(RecordingError, match=r"half\.toml: not a TOML file .*; is it whole"):
        read_rig_of(tmp_path / "half.toml")


@pytest.mark.parametrize(("square", "least_px"), [(True, 1e-5), (False, 0.02)])
def test_vicon_turns_by_its_quaternion_and_bends_the_other_way(
    tmp_path: Path, square: bool, least_px: float
) -> None:
    """Seen pixels are made ideal by Vicon's polynomial; ideal ones are K [R | -R position]. Its lens is round
    in pixels, OpenCV's on the plane before them: for square pixels they are the same."""
    rig = awkward_rig(n_cameras=3)
    if square:
        flat = [
            c.intrinsics * [[1, 1, 1], [1, c.intrinsics[0, 0] / c.intrinsics[1, 1], 1], [1, 1, 1]]
            for c in rig
        ]
        rig = Rig(tuple(replace(c, intrinsics=k) for c, k in zip(rig, flat, strict=True)))
    radial = np.array([1.5e-7, 4e-14, -1e-20])
    text = "<Cameras>"
    for k, c in enumerate(rig):
        quaternion = Rotation.from_matrix(c.camera_from_world[:3, :3]).as_quat()
        middle = texts(c.intrinsics[:2, 2]).replace(",", "")
        text += (
            (
                f'<Camera DEVICEID="21{k}" NAME="Vue_21{k}" TYPE="VideoFile" '
                f'SENSOR_SIZE="{c.size[0]} {c.size[1]}" '
                f'PIXEL_ASPECT_RATIO="{c.intrinsics[0, 0] / c.intrinsics[1, 1]!r}" SKEW="0">'
                f"<KeyFrames><KeyFrame "
                f'FRAME="0" FOCAL_LENGTH="{c.intrinsics[0, 0]!r}" PRINCIPAL_POINT="{middle}" '
                f'ORIENTATION="{texts(quaternion).replace(",", "")}" '
                f'POSITION="{texts(1000 * c.centre).replace(",", "")}" '
                f'VICON_RADIAL2="Vicon3Parameter {middle} {texts(radial).replace(",", "")}"/>'
                "</KeyFrames></Camera>"
            )
            .replace("np.float64(", "")
            .replace(")", "")
        )
    text += '<Camera DEVICEID="9" NAME="T160_9" TYPE="DxCore160" SENSOR_SIZE="9 9"><KeyFrames/></Camera>'
    text += "</Cameras>"
    (tmp_path / "a.xcp").write_text(text)
    found = read_rig_of(tmp_path / "a.xcp")
    assert found.unit == "mm" and found.names == ("Vue_210", "Vue_211", "Vue_212")
    assert "1 marker cameras left out" in found.notes[0]
    points = seen_points(rig)
    for given, read in zip(rig, found.rig(), strict=True):
        ideal = by_opencv(given, points)
        seen = read.project(1000 * points)[0]
        away = seen - given.intrinsics[:2, 2]
        r2 = (away**2).sum(axis=1, keepdims=True)
        undone = given.intrinsics[:2, 2] + away * (1 + r2 * (radial[0] + r2 * (radial[1] + r2 * radial[2])))
        inside = ((seen > 0) & (seen < given.size)).all(axis=1)
        assert inside.sum() > 30 and np.abs(undone - ideal)[inside].max() < least_px
        assert np.abs(seen - ideal).max() > 0.5, "the lens did nothing"


def test_zju_mocap_is_millimetres_and_named_by_its_folders(tmp_path: Path) -> None:
    rig = awkward_rig(5)
    cams = {
        "K": [c.intrinsics.tolist() for c in rig],
        "D": [c.distortion[:, None] for c in rig],
        "R": [c.camera_from_world[:3, :3].copy() for c in rig],
        "T": [1000 * c.camera_from_world[:3, 3:] for c in rig],
    }
    ims = [{"ims": [f"Camera_B{k + 1}/000000.jpg" for k in range(4)], "kpts2d": np.zeros((4, 25, 3))}] * 2
    for protocol in (2, 4, 5):
        with (tmp_path / "annots.npy").open("wb") as file:
            header = b"{'descr': '|O', 'fortran_order': False, 'shape': (), }".ljust(117) + b"\n"
            file.write(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
            pickle.dump(np.array({"cams": cams, "ims": ims}, dtype=object), file, protocol=protocol)
        found = read_rig_of(tmp_path / "annots.npy")
        assert found.unit == "mm" and found.names == ("Camera_B1", "Camera_B2", "Camera_B3", "Camera_B4")
        agrees(tmp_path / "annots.npy", rig, 1e-3)
    np.save(tmp_path / "annots.npy", np.array({"cams": cams, "ims": ims}, dtype=object), allow_pickle=True)
    agrees(tmp_path, rig, 1e-3)


class _Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return exec, ("import pathlib; pathlib.Path('went_off').touch()",)


def test_a_pickle_is_never_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("annots.npy", np.array({"cams": _Bomb()}, dtype=object), allow_pickle=True)
    with pytest.raises(RecordingError, match=r"names builtins.exec, which no table of cameras needs"):
        read_rig_of(Path("annots.npy"))
    assert not Path("went_off").exists()
    np.save("annots.npy", np.zeros((3, 4)))
    with pytest.raises(RecordingError, match="holds an array of float64, not a dictionary"):
        read_rig_of(Path("annots.npy"))
    np.save("annots.npy", np.array({"cams": {"K": [np.eye(3)] * 9}}, dtype=object), allow_pickle=True)
    content = Path("annots.npy").read_bytes()
    Path("annots.npy").write_bytes(content[: len(content) // 2])
    with pytest.raises(RecordingError, match="its pickle is not read"):
        read_rig_of(Path("annots.npy"))


def test_actorshq_gives_poses_and_fractions(tmp_path: Path) -> None:
    rig = awkward_rig()
    lines = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for c in rig:
        world_from_camera = np.linalg.inv(c.camera_from_world)
        vector = cv2.Rodrigues(world_from_camera[:3, :3].copy())[0].ravel()
        (w, h), k = c.size, c.intrinsics
        inside = [k[0, 0] / w, k[1, 1] / h, (k[0, 2] + 0.5) / w, (k[1, 2] + 0.5) / h]
        numbers = texts(np.array([*vector, *world_from_camera[:3, 3], *inside])).replace(" ", "")
        lines.append(f"{c.name},{w},{h},{numbers}")
    (tmp_path / "calibration.csv").write_text("\r\n".join(lines) + "\r\n")
    agrees(tmp_path, rig)
    (tmp_path / "calibration.csv").write_text("\n".join(lines)[:-40])
    with pytest.raises(RecordingError, match=r"line 5: \w+ is .*, no number; is the file whole"):
        read_rig_of(tmp_path)


def test_middlebury_is_k_r_t_a_line(tmp_path: Path) -> None:
    rig = awkward_rig()
    text = "4\n"
    for k, c in enumerate(rig):
        numbers = [*c.intrinsics.ravel(), *c.camera_from_world[:3, :3].ravel(), *c.camera_from_world[:3, 3]]
        text += f"templeR{k + 1:04d}.png " + texts(np.array(numbers)).replace(",", "") + "\n"
    (tmp_path / "templeR_par.txt").write_text(text)
    cv2.imwrite(str(tmp_path / "templeR0002.png"), np.zeros((800, 600), np.uint8))
    agrees(tmp_path / "templeR_par.txt", rig)
    found = read_rig_of(tmp_path / "templeR_par.txt")
    assert found.unit is None and found.names[1] == "templeR0002"
    assert found.cameras[1].size == (600, 800) and found.cameras[0].size is None
    (tmp_path / "templeR_par.txt").write_text(text[:-100])
    with pytest.raises(RecordingError, match=r"4 pictures announced, 3\.\d+ lines .* is the file whole"):
        read_rig_of(tmp_path / "templeR_par.txt")


def test_opencv_files_in_the_layouts_that_people_use(tmp_path: Path) -> None:
    rig = awkward_rig(5)
    (tmp_path / "each").mkdir()
    for c in rig:
        storage = cv2.FileStorage(str(tmp_path / "each" / f"{c.name}.xml"), cv2.FILE_STORAGE_WRITE)
        storage.write("cameraMatrix", c.intrinsics.copy())
        storage.write("distCoeffs", c.distortion[:, None].copy())
        storage.write("rvec", cv2.Rodrigues(c.camera_from_world[:3, :3].copy())[0])
        storage.write("tvec", c.camera_from_world[:3, 3].copy())
        storage.write("imageSize", np.array(c.size))
        storage.release()
    plain = {
        c.name: {
            "K": c.intrinsics.tolist(),
            "distCoef": c.distortion.tolist(),
            "R": c.camera_from_world[:3, :3].tolist(),
            "t": c.camera_from_world[:3, 3:].tolist(),
            "resolution": list(c.size),
        }
        for c in rig
    }
    (tmp_path / "map.json").write_text(json.dumps({"cameras": plain}))
    (tmp_path / "list.json").write_text(
        json.dumps({"cameras": [{"name": name, **camera} for name, camera in plain.items()]})
    )
    multical = {
        "cameras": {
            c.name: {"model": "standard", "image_size": c.size, "K": c.intrinsics.tolist(),
                     "dist": [c.distortion.tolist()]}
            for c in rig
        },
        "camera_poses": {
            c.name if k == 0 else f"{c.name}_to_cam-000": {
                "R": c.camera_from_world[:3, :3].tolist(), "T": c.camera_from_world[:3, 3].tolist()
            }
            for k, c in enumerate(rig)
        },
    }  # fmt: skip
    (tmp_path / "multical.json").write_text(json.dumps(multical))
    poses = {
        c.name: {
            "camera_matrix": c.intrinsics.tolist(),
            "distortion_vector": c.distortion.tolist(),
            "camera_pose_matrix": np.linalg.inv(c.camera_from_world).tolist(),
            "img_width": c.size[0],
            "img_height": c.size[1],
        }
        for c in rig
    }
    (tmp_path / "mccalib.json").write_text(json.dumps({"nb_camera": 4, **poses}))
    storage = cv2.FileStorage(str(tmp_path / "suffix.yml"), cv2.FILE_STORAGE_WRITE)
    for k, c in enumerate(rig):
        storage.write(f"K_{k}", c.intrinsics.copy())
        storage.write(f"dist_{k}", c.distortion[None].copy())
        storage.write(f"RT_{k}", c.camera_from_world.copy())
    storage.release()
    for path in ("each", "map.json", "list.json", "multical.json", "mccalib.json", "suffix.yml"):
        assert detect_format(tmp_path / path) == "opencv", path
        agrees(tmp_path / path, rig)
    assert read_rig_of(tmp_path / "each").names == rig.names
    ros = (
        "image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
        "  data: [500., 0., 320., 0., 500., 240., 0., 0., 1.]\n"
    )
    (tmp_path / "ros.yaml").write_text(ros)
    with pytest.raises(RecordingError, match="camera left: intrinsics without a pose"):
        read_rig_of(tmp_path / "ros.yaml")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"R": (-np.eye(3)).tolist()}, "mirrored calibration .its rotation has determinant -1"),
        ({"R": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "its 3x3 rotation is none"),
        ({"t": [0, float("nan"), 1]}, "its translation holds nan; every value must be a finite number"),
        ({"K": [[500, 0, 0], [0, 500, 0], [320, 240, 1]]}, "is the matrix transposed"),
        (
            {"K": [[-500, 0, 320], [0, 500, 240], [0, 0, 1]]},
            "focal lengths -500 and 500 px must both be positive",
        ),
        ({"distCoef": [0.1] * 12}, "12 distortion values; the thin prism and tilt terms"),
        ({"resolution": [0, 480]}, "picture size 0.0 x 480.0 is not one in pixels"),
        ({"K": "wide"}, "'wide' is not made of numbers"),
    ],
)
def test_what_is_wrong_with_a_camera_is_named(tmp_path: Path, change: dict[str, object], words: str) -> None:
    camera = {"K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "R": np.eye(3).tolist(), "t": [0, 0, 1],
              "resolution": [640, 480]}  # fmt: skip
    (tmp_path / "a.json").write_text(json.dumps({"cameras": {"left": camera | change}}))
    with pytest.raises(RecordingError, match=r"a\.json: camera left.*" + words):
        read_rig_of(tmp_path / "a.json")


def test_half_a_colmap_model_is_refused(tmp_path: Path) -> None:
    write_rig(awkward_rig(4), tmp_path, "colmap")
    for part in ("images", "cameras"):
        whole = (tmp_path / f"{part}.bin").read_bytes()
        (tmp_path / f"{part}.bin").write_bytes(whole[: len(whole) // 2])
        with pytest.raises(RecordingError, match=rf"{part}\.bin: ends early or is damaged"):
            read_rig_of(tmp_path)
        (tmp_path / f"{part}.bin").write_bytes(whole)


@pytest.mark.parametrize("name", FORMATS)
def test_half_a_file_is_an_error_in_one_or_two_lines(tmp_path: Path, name: str) -> None:
    """Each file of each format, cut at many places: refused, or still whole as far as numbers go."""
    rig = awkward_rig(0 if name in ("inria", "actorshq", "middlebury", "vicon") else 5)
    files, _ = write_rig(rig, tmp_path / "out", name)
    if name.startswith("colmap"):
        files = [file for file in files if file.stem in ("cameras", "images")]
    refused = 0
    for file in files[:2]:
        whole = file.read_bytes()
        for share in (0.0, 0.1, 0.35, 0.6, 0.9):
            file.write_bytes(whole[: int(share * len(whole))])
            try:
                read_rig_of(tmp_path / "out").rig((640, 480))
            except RecordingError as error:
                refused += 1
                assert len(str(error).splitlines()) <= 2
        file.write_bytes(whole)
    assert refused >= 4
