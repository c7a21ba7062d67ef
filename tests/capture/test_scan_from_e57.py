"""E57 files, written with libE57 itself, node by node, as ASTM E2807 names them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.capture.test_scan_from_blocks_exchange import _document as _block
from tests.capture.test_scan_from_blocks_exchange import _write as _write_block
from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image
from tests.scenes import write_ply
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.e57 import frame_records
from usdbrdf.capture.formats.named_pictures import pictures_of
from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted import e57_files

libe57 = pytest.importorskip("pye57").libe57
OPTIONS = IngestOptions(assume_srgb=True)
_PIXEL = 4e-6  # metres


def _structure(file, **parts):
    node = libe57.StructureNode(file)
    for name, part in parts.items():
        if isinstance(part, dict):
            part = _structure(file, **part)
        elif isinstance(part, str):
            part = libe57.StringNode(file, part)
        elif isinstance(part, int):
            part = libe57.IntegerNode(file, part, 0, 1 << 20)
        else:
            part = libe57.FloatNode(file, float(part), libe57.E57_DOUBLE, -1e9, 1e9)
        node.set(name, part)
    return node


def _pose(matrix):
    x, y, z, w = Rotation.from_matrix(matrix[:3, :3]).as_quat()
    place = dict(zip("xyz", matrix[:3, 3], strict=True))
    return {"rotation": {"w": w, "x": x, "y": y, "z": z}, "translation": place}


def _write(path, pictures, remark=""):
    file = libe57.ImageFile(str(path), "w")
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    file.extensionsAdd("dist", "http://www.libe57.org/E57_LEICA_Camera_Distortion.txt")
    root = file.root()
    root.set("formatName", libe57.StringNode(file, "ASTM E57 3D Imaging Data File"))
    root.set("coordinateMetadata", libe57.StringNode(file, remark))
    images = libe57.VectorNode(file, True)
    root.set("images2D", images)
    for picture in pictures:
        images.append(_structure(file, guid="{0}", **picture))
    file.close()


def _pinholes(room):
    fx, fy, cx, cy = room.intrinsics[0]
    shown = {
        "imageWidth": WIDTH, "imageHeight": HEIGHT, "focalLength": fx * _PIXEL,
        "pixelWidth": _PIXEL, "pixelHeight": fx / fy * _PIXEL,
        "principalPointX": cx, "principalPointY": cy,
    }  # fmt: skip
    return [
        {"name": f"station {i}", "pose": _pose(pose), "pinholeRepresentation": shown}
        for i, pose in enumerate(room.world_from_camera)
    ]


@pytest.fixture
def room():
    return truth()


@pytest.fixture
def survey(tmp_path, room):
    return write_survey(tmp_path / "survey", room)


def write_survey(folder, room):
    """Stations with pinhole pictures, and a mesh beside them; returns the folder."""
    folder.mkdir(parents=True)
    _write(folder / "scan.e57", _pinholes(room))
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"station {i}.jpg", image)
    write_ply(folder / "mesh.ply", room.points, room.triangles, room.face_object)
    return folder


def test_pinholes_of_stations(survey, room):
    assert choose_adapter(survey).name == "e57"
    scan = read_scan(survey, OPTIONS)
    assert_same(scan, room)
    assert (scan.adapter, scan.up_axis, len(scan.objects)) == ("e57", "Z", len(room.names))


def test_a_sphere_has_x_ahead_and_turns_to_the_left(tmp_path, room):
    """Azimuth from x towards y, elevation from the horizon up, 0 in the middle of the picture."""
    turn = Rotation.from_euler("xyz", [10, 20, 130], degrees=True).as_matrix()
    station = np.eye(4)
    station[:3, :3], station[:3, 3] = turn, (2.0, 1.5, 1.2)
    width, height = 2 * WIDTH, WIDTH
    shown = {
        "imageWidth": width, "imageHeight": height,
        "pixelWidth": 2 * np.pi / width, "pixelHeight": np.pi / height,
    }  # fmt: skip
    path = tmp_path / "scan.e57"
    _write(path, [{"name": "pano", "pose": _pose(station), "sphericalRepresentation": shown}])
    write_image(tmp_path / "images" / "pano.jpg", np.ones((height, width, 3)))
    pictures = pictures_of(tmp_path, OPTIONS)
    (record,) = frame_records(e57_files.pictures_of_e57(path), pictures, Findings())
    points = room.points[::5].astype(np.float64)
    local = (points - station[:3, 3]) @ turn
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    elevation = np.arctan2(local[:, 2], np.hypot(local[:, 0], local[:, 1]))
    expected = np.stack(
        [width / 2 - azimuth * width / (2 * np.pi), height / 2 - elevation * height / np.pi], axis=1
    )
    pose = record.world_from_camera
    seen = record.lens.project((points - pose[:3, 3]) @ pose[:3, :3], record.intrinsics)
    np.testing.assert_allclose(seen, expected, atol=1e-6)


def _bent(room, model, calibrated):
    """By the extension of Leica, with OpenCV's terms."""
    terms = dict(
        zip(("K1", "K2", "K3", "K4", "K5", "K6"), (-0.1, 0.03, 0.0, 0.02, 0.0, 0.0), strict=True)
    )
    terms |= {"P1": 0.004, "P2": -0.003}
    terms |= dict(zip(("FX", "FY", "CX", "CY"), calibrated, strict=True))
    stated = {f"dist:CV_{name}": value for name, value in terms.items()}
    sides = {"dist:CV_HEIGHT": HEIGHT, "dist:CV_WIDTH": WIDTH}
    return [
        {**picture, "dist:distortion": {"dist:Type": model, **stated, **sides}}
        for picture in _pinholes(room)
    ]


@pytest.mark.parametrize("off", [(0.0, 0.0), (-0.5, -0.5), (1.5, 2.5)])
def test_pinholes_that_bend_light_by_the_extension(survey, room, off):
    """Radial, dividing and tangential terms as cv2.projectPoints has them."""
    fx, fy, cx, cy = room.intrinsics[0]
    _write(survey / "scan.e57", _bent(room, "OpenCV", (fx, fy, cx + off[0], cy + off[1])))
    taken = e57_files.pictures_of_e57(survey / "scan.e57")
    record = frame_records(taken, pictures_of(survey, OPTIONS), Findings())[0]
    x, y = 0.31, -0.23
    r2 = x * x + y * y
    radial = (1 - 0.1 * r2 + 0.03 * r2**2) / (1 + 0.02 * r2)
    u = x * radial + 2 * 0.004 * x * y - 0.003 * (r2 + 2 * x * x)
    v = y * radial + 0.004 * (r2 + 2 * y * y) - 2 * 0.003 * x * y
    pixel = record.lens.project(np.array([x, -y, -1.0]), record.intrinsics)
    # A calibration of its own counts from the middle of the first pixel.
    right, down = (off[0] + 0.5, off[1] + 0.5) if off[0] > 0 else (0.0, 0.0)
    np.testing.assert_allclose(pixel, [cx + fx * u + right, cy + fy * v + down], atol=1e-9)


def test_masks_beside_are_used_and_those_inside_told(survey, room):
    pictures = _pinholes(room)
    for picture in pictures[:4]:
        # A blob, which holds a PNG, but nothing reads it.
        shown = picture["pinholeRepresentation"]
        picture["pinholeRepresentation"] = {**shown, "imageMask": "blob"}
    _write(survey / "scan.e57", pictures)
    half = np.ones((HEIGHT, WIDTH, 3))
    half[: HEIGHT // 2] = 0
    write_image(survey / "masks" / "station 0.png", half)
    scan = read_scan(survey, OPTIONS)
    assert [mask is not None for mask in scan.frames.masks] == [True] + 9 * [False]
    (told,) = [s for s in scan.warnings if "imageMask" in s]
    assert told.startswith("scan.e57: 3 pictures have a mask inside")
    assert not any("nothing is masked" in sentence for sentence in scan.warnings)


def test_names_that_no_file_may_have_are_found_with_underscores(survey, room):
    pictures = [{**p, "name": f"scans/1:station {i}?"} for i, p in enumerate(_pinholes(room))]
    _write(survey / "scan.e57", pictures)
    for i in range(len(pictures)):
        image = survey / "images" / f"station {i}.jpg"
        image.rename(image.with_stem(f"scans_1_station {i}_"))
    assert_same(read_scan(survey, OPTIONS), room)


def test_pictures_without_a_name_and_on_a_cylinder_are_told_as_such(survey, room):
    pictures = _pinholes(room)
    del pictures[0]["name"]
    round_about = {"imageWidth": WIDTH, "imageHeight": HEIGHT, "radius": 1.0, "pixelWidth": 0.01}
    shown = {**pictures[1], "cylindricalRepresentation": round_about}
    del shown["pinholeRepresentation"]
    pictures[1] = shown
    _write(survey / "scan.e57", pictures)
    scan = read_scan(survey, OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[2:])
    dropped = [s for s in scan.warnings if "1 of 10 frames dropped" in s]
    assert [s for s in dropped if "'a picture': the E57 gives it no name" in s]
    assert [s for s in dropped if "'station 1': a cylindrical picture" in s]


def test_of_several_files_one_is_to_be_named(survey, room):
    (survey / "scan.e57").rename(survey / "outside.E57")
    (survey / "inside.e57").write_bytes((survey / "outside.E57").read_bytes())
    with pytest.raises(InputRefused, match=r"holds 2 E57 files, first inside.e57\. Name the one"):
        choose_adapter(survey)
    _write(survey / "inside.e57", [])
    assert_same(read_scan(survey, OPTIONS), room)
    with pytest.raises(InputRefused, match=r"inside.e57: an E57 without pictures.*capture.frames"):
        read_scan(survey / "inside.e57", OPTIONS)


@pytest.mark.parametrize("remark", ["", 5000 * "far "])
def test_a_laser_scan_beside_another_capture_is_not_the_capture(tmp_path, room, remark):
    """However many pages its text has, each with a checksum."""
    folder = tmp_path / "block"
    _write_block(folder, room, _block(room))
    _write(folder / "scan.e57", [], remark)
    assert choose_adapter(folder).name == "blocks-exchange"


def test_a_lens_of_another_model_is_told(survey, room):
    _write(survey / "scan.e57", _bent(room, "Kannala", room.intrinsics[0]))
    with pytest.raises(InputRefused, match=r"its lens is distorted by a model.*'Kannala'"):
        read_scan(survey, OPTIONS)


def _no_mesh(survey, room):
    (survey / "mesh.ply").unlink()


def _inside(survey, room):
    for path in (survey / "images").iterdir():
        path.unlink()


def _no_images2d(survey, room):
    _write(survey / "scan.e57", [])


def _no_poses(survey, room):
    pictures = _pinholes(room)
    for picture in pictures[:5]:
        del picture["pose"]
    _write(survey / "scan.e57", pictures)


def _damaged(survey, room):
    (survey / "scan.e57").write_bytes(b"ASTM-E57" + bytes(3000))


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_mesh, r"no mesh\. An E57 holds points.*--mesh\. \[mesh.missing\]"),
        (_inside, r"its 10 pictures.*inside the file.*--frames\. \[capture.frames\]"),
        (_no_images2d, r"scan.e57 is an E57 without pictures.*\[adapter.none\]"),
        (_no_poses, r"only 5 of 10 frames.*without pose.*\[capture.camera\]"),
        (_damaged, r"damaged or no E57 file.*\[e57.read\]"),
    ],
)
def test_refusals(survey, room, damage, sentence):
    damage(survey, room)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(survey, OPTIONS)


def test_without_the_reader_it_says_what_to_install(survey, monkeypatch):
    monkeypatch.setattr(e57_files, "find_spec", lambda name: None)
    with pytest.raises(EnvironmentFailure, match=r"usdbrdf\[e57\].*\[environment.pye57\]"):
        read_scan(survey, OPTIONS)
