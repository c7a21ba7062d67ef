"""Projects in the Open Photogrammetry Format, written after its specification (Pix4D/opf-spec)."""

from __future__ import annotations

import json
from dataclasses import replace
from urllib.parse import quote

import numpy as np
import pytest

from tests.format_truth import (
    HEIGHT,
    WIDTH,
    assert_bends,
    assert_same,
    brown,
    truth,
    write_image,
    write_obj,
)
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.reconstructions.opf import shots_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
SENSOR, FIRST = 18493134, 2**63 + 11  # numbers have 64 bits


def _angles(turn):
    """Omega, phi, kappa in degrees of R_x R_y R_z, multiplied out."""
    omega = np.arctan2(-turn[1, 2], turn[2, 2])
    return np.degrees([omega, np.arcsin(turn[0, 2]), np.arctan2(-turn[0, 1], turn[0, 0])]).tolist()


def _perspective(room, radial=(0, 0, 0), tangential=(0, 0)):
    fx, _, cx, cy = room.intrinsics[0]
    return {
        "type": "perspective",
        "focal_length_px": fx,
        "principal_point_px": [cx, cy],
        "radial_distortion": list(radial),
        "tangential_distortion": list(tangential),
    }


def _system(*metres):
    """A coordinate system in WKT whose axes have units of these lengths."""
    axes = ",".join(f'AXIS["x",up,ORDER[1],LENGTHUNIT["some unit",{unit}]]' for unit in metres)
    turn = 'PRIMEM["Greenwich",0,ANGLEUNIT["degree",0.0174532925199433]]'
    earth = 'ELLIPSOID["WGS 84",6378137,298.257223563,LENGTHUNIT["metre",1]]'
    return f'PROJCRS["x",BASEGEOGCRS["x",DATUM["x",{earth}],{turn}],CS[Cartesian,3],{axes}]'


def _documents(room, internals=None, uri=lambda i: f"photos/{i:04d}.jpg"):
    """Of each kind its format and what it says."""
    cameras = [
        {
            "id": FIRST + i,
            "sensor_id": SENSOR,
            "position": pose[:3, 3].tolist(),
            "orientation_deg": _angles(pose[:3, :3]),
        }
        for i, pose in enumerate(room.world_from_camera)
    ]
    sensor = {"id": SENSOR, "internals": internals or _perspective(room)}
    size = {"id": SENSOR, "image_size_px": [WIDTH, HEIGHT], "internals": _perspective(room)}
    listed = [{"id": FIRST + i, "uri": uri(i)} for i in reversed(range(len(cameras)))]
    shift = {"shift": [-746308.1, -3714810.9, -268.7], "scale": [1, 1, 1], "swap_xy": False}
    return {
        "camera-list": {"cameras": listed},
        "input-cameras": {"sensors": [size], "captures": []},
        "calibrated-cameras": {"sensors": [sensor], "cameras": cameras},
        "scene-reference-frame": {
            "crs": {"definition": _system("1.0")},
            "base_to_canonical": shift,
        },
    }


def _write(folder, room, documents):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"{i:04d}.jpg", image)
    write_obj(folder / "mesh.obj", room)
    (folder / "parts").mkdir()
    items = []
    for kind, document in documents.items():
        said = {"format": f"application/opf-{kind}+json", "version": "1.0"}
        (folder / f"parts/the {kind}.json").write_text(json.dumps(said | document))
        resource = {"uri": f"parts/the%20{kind}.json", "format": said["format"]}
        items.append({"id": kind, "type": kind, "sources": [], "resources": [resource]})
    project = {"format": "application/opf-project+json", "version": "1.0", "items": items}
    (folder / "room.opf").write_text(json.dumps(project))
    return folder


@pytest.mark.parametrize(
    "uri",
    [
        lambda i: f"photos/{i:04d}.jpg",
        lambda i: f"file:///c:/my%20data/{i:04d}.jpg",
        lambda i: f"{i:04d}.jpg#page=0",
        # No URIs, though they begin as such.
        lambda i: f"file://[x/{i:04d}.jpg",
        lambda i: f"//a\u2100b/{i:04d}.jpg",
    ],
)
def test_the_project_is_the_room(tmp_path, uri):
    room = truth().square()
    _write(tmp_path, room, _documents(room, uri=uri))
    assert choose_adapter(tmp_path).name == choose_adapter(tmp_path / "room.opf").name == "opf"
    scan = read_scan(tmp_path, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert (scan.adapter, scan.up_axis, scan.meters_per_unit) == ("opf", "Z", 1.0)
    assert not any("--meters-per-unit" in said for said in scan.warnings)


def _bent(folder, internals):
    documents = _documents(truth(), internals)
    lists = [[documents[name]] for name in ("camera-list", "input-cameras")]
    return shots_of(*lists, documents["calibrated-cameras"], folder)[0]


def test_distortion_is_that_of_pix4d(tmp_path):
    """R1 to R3 and T1, T2, which AliceVision's Brown has too."""
    room, terms = truth().square(), [-0.1, 0.02, 0.01, 0.004, -0.003]
    shot = _bent(tmp_path, _perspective(room, terms[:3], terms[3:]))
    assert_bends(shot.camera, room, brown, terms)


@pytest.mark.parametrize("affine", [[30.0, 0, 0, 30.0], [29.0, 0.4, -0.3, 30.5]])
def test_a_fisheye_is_that_of_pix4d(tmp_path, affine):
    """rho = p1 t + p2 t^2 + p3 t^3 of t = 2 / pi atan(r); pixels are the affine of it."""
    polynomial, centre = [0.0, 1.0, 0.0152646, -0.161096], np.array([15.25, 12.75])
    internals = {
        "type": "fisheye", "affine": affine, "polynomial": polynomial,
        "principal_point_px": centre.tolist(), "is_symmetric_affine": False, "is_p0_zero": True,
    }  # fmt: skip
    shot, point = _bent(tmp_path, internals), truth().points[0] + (0.1, 0.2, 0.0)
    in_truth = np.linalg.inv(truth().opencv[0]) @ (*point, 1.0)
    across = np.hypot(in_truth[0], in_truth[1])
    rho = np.polyval(polynomial[::-1], 2 / np.pi * np.arctan2(across, in_truth[2]))
    expected = np.reshape(affine, (2, 2)) @ (rho * in_truth[:2] / across) + centre
    local = np.linalg.inv(shot.world_from_camera) @ (*point, 1.0)
    seen = shot.camera.lens.project(local[:3] * (1, -1, -1), shot.camera.intrinsics)
    np.testing.assert_allclose(seen, expected, atol=1e-9)


def test_a_sphere_is_one(tmp_path):
    shot = _bent(tmp_path, {"type": "spherical", "principal_point_px": [16, 12]})
    assert shot.camera.lens.curve == "equirectangular"


def test_what_is_no_photograph_of_the_calibration_is_left_out(tmp_path):
    room = truth().square()
    documents = _documents(room, uri=lambda i: f"{i:04d}.jpg" + "#page=1" * (i == 3))
    del documents["camera-list"]["cameras"][0]
    calibrated = documents["calibrated-cameras"]["cameras"]
    calibrated[5]["rolling_shutter"] = [0.1, 0, 0]
    scan = read_scan(_write(tmp_path, room, documents), OPTIONS)
    assert len(scan.frames) == 8
    said = " ".join(scan.warnings)
    assert "page 1 of its file" in said
    assert "capture.shutter" in said


@pytest.mark.parametrize(
    "frame",
    [
        {},
        {"crs": {}},
        {"crs": {"definition": "EPSG:2229+6360"}},  # in feet, which its authority alone knows
        {"crs": {"definition": _system("0.3048")}},
        {"crs": {"definition": _system("1", "0.304800609601219")}},
        {"crs": {"definition": _system("1") + 'UNIT["x",0.3]'}},
    ],
)
def test_a_coordinate_system_not_known_to_be_in_metres_is_told(tmp_path, frame):
    room, documents = truth().square(), _documents(truth().square())
    documents["scene-reference-frame"] = frame
    _write(tmp_path, room, documents)
    told = [said for said in read_scan(tmp_path, OPTIONS).warnings if "capture.unit" in said]
    assert ["--meters-per-unit" in said for said in told] == [True]
    scan = read_scan(tmp_path, replace(OPTIONS, meters_per_unit=0.3048))
    assert not any("capture.unit" in said for said in scan.warnings)


def test_parts_may_be_named_by_where_the_file_lies(tmp_path):
    project = _write(tmp_path, truth().square(), _documents(truth().square())) / "room.opf"
    folder = f"file://{quote(str(tmp_path.resolve()))}"
    project.write_text(project.read_text().replace('"parts/', f'"{folder}/parts/'))
    assert_same(read_scan(tmp_path, OPTIONS), truth().square())
    project.write_text(project.read_text().replace(folder, "file:///elsewhere"))
    with pytest.raises(InputRefused, match="only relative paths"):
        read_scan(tmp_path, OPTIONS)


def test_without_a_reference_frame_nobody_knows_the_scale(tmp_path):
    room, documents = truth().square(), _documents(truth().square())
    del documents["scene-reference-frame"]
    scan = read_scan(_write(tmp_path, room, documents), OPTIONS)
    assert any("--meters-per-unit" in said for said in scan.warnings)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("calibrated-cameras"), "no calibrated cameras"),
        (
            lambda d: d["calibrated-cameras"]["sensors"][0]["internals"].update(type="x"),
            "'x'.*transforms",
        ),
        (
            lambda d: d["calibrated-cameras"]["sensors"][0]["internals"].pop("type"),
            "no stated type",
        ),
        (lambda d: d["calibrated-cameras"].update(cameras=[]), "frames"),
    ],
)
def test_what_is_refused(tmp_path, change, words):
    documents = _documents(truth())
    change(documents)
    _write(tmp_path, truth(), documents)
    with pytest.raises(InputRefused, match=words):
        read_scan(tmp_path, OPTIONS)


def test_parts_that_are_gone_or_lead_outside_are_refused(tmp_path):
    _write(tmp_path, truth(), _documents(truth()))
    (tmp_path / "parts/the input-cameras.json").unlink()
    with pytest.raises(InputRefused, match="which is not there"):
        read_scan(tmp_path, OPTIONS)
    project = tmp_path / "room.opf"
    project.write_text(project.read_text().replace("parts/the%20input", "..%2F..%2Fthe%20input"))
    with pytest.raises(InputRefused, match="leads outside"):
        read_scan(tmp_path, OPTIONS)


def test_a_part_alone_names_the_project(tmp_path):
    _write(tmp_path, truth(), _documents(truth()))
    with pytest.raises(InputRefused, match=r"Name the project's folder"):
        read_scan(tmp_path / "parts/the input-cameras.json", OPTIONS)
