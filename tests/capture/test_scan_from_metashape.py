"""Metashape's XML, written after Agisoft's manual (Appendix: camera models) and its exports."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.format_truth import HEIGHT, WIDTH, assert_same, truth, write_image, write_obj
from usdbrdf.capture.adapters import choose_adapter, read_scan
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.metashape import frame_records
from usdbrdf.capture.formats.named_pictures import pictures_of
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
# x_world = SCALE * TURN x_chunk + SHIFT
TURN = Rotation.from_euler("xyz", [20, -50, 110], degrees=True).as_matrix()
SHIFT, SCALE = np.array([3.0, -2.0, 1.0]), 2.5


def _text(values):
    return " ".join(f"{value:.17e}" for value in np.ravel(values))


def _child(parent, tag, text=None, **attributes):
    made = ET.SubElement(parent, tag, attributes)
    made.text = text
    return made


def _sensor(sensors, number, kind="frame", master=None, **calibration):
    ids = {"id": str(number), "label": f"camera {number}", "type": kind}
    sensor = _child(sensors, "sensor", **ids, **({"master_id": str(master)} if master else {}))
    _child(sensor, "resolution", width=str(WIDTH), height=str(HEIGHT))
    if calibration:
        first = _child(sensor, "calibration", type=kind, **{"class": "initial"})
        _child(first, "resolution", width=str(WIDTH), height=str(HEIGHT))
        _child(first, "f", "99")
        adjusted = _child(sensor, "calibration", type=kind, **{"class": "adjusted"})
        _child(adjusted, "resolution", width=str(WIDTH), height=str(HEIGHT))
        for name, value in calibration.items():
            _child(adjusted, name, repr(float(value)))
    return sensor


def _chunk(*, component=False):
    document = ET.Element("document", version="2.0.0")
    chunk = _child(document, "chunk", label="Chunk 1", enabled="true")
    sensors = _child(chunk, "sensors", next_id="4")
    holder = chunk
    if component:
        holder = _child(_child(chunk, "components"), "component", id="5")
    cameras = _child(chunk, "cameras")
    transform = _child(holder, "transform")
    _child(transform, "rotation", _text(TURN), locked="false")
    _child(transform, "translation", _text(SHIFT), locked="false")
    _child(transform, "scale", repr(SCALE), locked="true")
    return document, sensors, cameras


def _in_chunk(pose):
    """A camera's transform to the chunk, from its pose (OpenCV's axes) in the world."""
    found = np.eye(4)
    found[:3, :3] = TURN.T @ pose[:3, :3]
    found[:3, 3] = TURN.T @ (pose[:3, 3] - SHIFT) / SCALE
    return found


def _lens(room):
    fx, fy, cx, cy = room.intrinsics[0]
    return {"f": fy, "cx": cx - WIDTH / 2, "cy": cy - HEIGHT / 2, "b1": fx - fy}


@pytest.fixture
def room():
    return truth()


def _write(folder, document, room, suffix=".jpg"):
    for i, image in enumerate(room.images):
        write_image(folder / "images" / f"DSC{i:04d}{suffix}", image)
    write_obj(folder / "model.obj", room)
    ET.ElementTree(document).write(folder / "cameras.xml", encoding="UTF-8", xml_declaration=True)
    return folder


@pytest.fixture
def project(tmp_path, room):
    return write_project(tmp_path / "project", room)


def write_project(folder, room):
    """One sensor, cameras in a group and beside it; returns the folder."""
    document, sensors, cameras = _chunk()
    _sensor(sensors, 0, **_lens(room))
    group = _child(cameras, "group", id="0", label="walk", type="folder")
    for i, pose in enumerate(room.opencv):
        # Labels have their suffix or have not, by version.
        label = f"DSC{i:04d}.JPG" if i % 2 else f"DSC{i:04d}"
        parent = group if i > 5 else cameras
        camera = _child(parent, "camera", id=str(i), sensor_id="0", label=label)
        _child(camera, "transform", _text(_in_chunk(pose)))
    return _write(folder, document, room)


@pytest.mark.parametrize(
    ("place", "text", "told"),
    [
        ("camera", "0 0 0 0.1 -0.02 3e-3", True),
        ("camera", "0 0 0 0 0.0 0e+00", False),
        ("sensor", "true", True),
        ("sensor", "Disabled", False),
        ("sensor", None, False),
    ],
)
def test_a_rolling_shutter_is_told(project, place, text, told):
    """Metashape compensates for it, which was passed over in silence."""
    document = ET.parse(project / "cameras.xml")
    holder = document.getroot().find(f".//{place}")
    _child(holder, "rolling_shutter", text)
    document.write(project / "cameras.xml")
    findings = Findings()
    pictures = pictures_of(project, OPTIONS)
    assert len(frame_records(project / "cameras.xml", pictures, OPTIONS, findings)) > 5
    assert [s for s in findings.warnings if "[capture.shutter]" in s] == findings.warnings[:told]


@pytest.mark.parametrize("unused", ["sensor", "camera"])
def test_a_rolling_shutter_of_what_is_not_used_is_not_told(project, unused):
    document = ET.parse(project / "cameras.xml")
    if unused == "sensor":
        holder = _child(document.getroot().find(".//sensors"), "sensor", id="9")
    else:
        holder = document.getroot().find(".//camera")
        holder.set("enabled", "false")
    _child(holder, "rolling_shutter", "true")
    document.write(project / "cameras.xml")
    findings = Findings()
    frame_records(project / "cameras.xml", pictures_of(project, OPTIONS), OPTIONS, findings)
    assert not any("[capture.shutter]" in said for said in findings.warnings)


def test_cameras_of_a_chunk(project, room):
    assert choose_adapter(project).name == "metashape"
    assert choose_adapter(project / "cameras.xml").name == "metashape"
    scan = read_scan(project, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert (scan.adapter, scan.up_axis, scan.meters_per_unit) == ("metashape", "Z", 1.0)


@pytest.mark.parametrize("placed", [True, False])
def test_cameras_of_a_component_that_was_not_aligned_with_the_others_are_left_out(
    tmp_path, room, placed
):
    """Each component that is not placed has coordinates of its own."""
    document, sensors, cameras = _chunk(component=True)
    _sensor(sensors, 0, **_lens(room))
    parts = document.find("chunk/components")
    _child(parts, "component", id="6")
    if not placed:
        (first,) = parts.iterfind("component[@id='5']")
        first.remove(first.find("transform"))
    for i, pose in enumerate(room.opencv):
        own = _in_chunk(pose) if placed else pose
        own = own if i < 9 else np.eye(4)
        ids = {"id": str(i), "sensor_id": "0", "component_id": "56"[i == 9]}
        camera = _child(cameras, "camera", label=f"DSC{i:04d}", **ids)
        _child(camera, "transform", _text(own))
    scan = read_scan(_write(tmp_path / "project", document, room), OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[:9])
    assert any("'6' stands nowhere among the others" in sentence for sentence in scan.warnings)


@pytest.mark.parametrize("alone", [True, False])
def test_cameras_that_name_no_component_are_of_the_only_one(tmp_path, room, alone):
    """They stood in the coordinates of the chunk, which only components lead out of."""
    document, sensors, cameras = _chunk(component=True)
    _sensor(sensors, 0, **_lens(room))
    if not alone:
        _child(document.find("chunk/components"), "component", id="6")
    for i, pose in enumerate(room.opencv):
        ids = {"id": str(i), "sensor_id": "0"} | ({"component_id": "5"} if i < 9 else {})
        camera = _child(cameras, "camera", label=f"DSC{i:04d}", **ids)
        _child(camera, "transform", _text(_in_chunk(pose)))
    scan = read_scan(_write(tmp_path / "project", document, room), OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[: 10 if alone else 9])
    assert any("it names no component" in said for said in scan.warnings) != alone


def test_a_component_says_where_it_stands_before_the_chunk(tmp_path, room):
    document, sensors, cameras = _chunk(component=True)
    _sensor(sensors, 0, **_lens(room))
    _child(_child(document.find("chunk"), "transform"), "scale", "1")
    for i, pose in enumerate(room.opencv):
        ids = {"id": str(i), "sensor_id": "0", "component_id": "5"}
        camera = _child(cameras, "camera", label=f"DSC{i:04d}", **ids)
        _child(camera, "transform", _text(_in_chunk(pose)))
    assert_same(read_scan(_write(tmp_path / "project", document, room), OPTIONS), room)


@pytest.mark.parametrize("encoding", ["UTF-16", "UTF-16LE", "ISO-8859-1", "windows-1252"])
def test_a_document_is_read_in_what_it_says_that_it_is_written_in(project, room, encoding):
    """As editors and scripts save it."""
    document = project / "cameras.xml"
    text = document.read_text("utf-8").replace("Chunk 1", "Fa\u00e7ade").partition("?>")[2]
    declared = f'<?xml version="1.0" encoding="{encoding.removesuffix("LE")}"?>'
    document.write_bytes((declared + text).encode(encoding))
    assert choose_adapter(project).name == "metashape"
    assert_same(read_scan(project, OPTIONS), room)


def test_an_export_may_be_called_in_capitals(project, room):
    (project / "cameras.xml").rename(project / "CAMERAS.XML")
    assert choose_adapter(project).name == "metashape"
    assert_same(read_scan(project, OPTIONS), room, names=room.names)


@pytest.mark.parametrize("empty", ["<chunk/>", "<chunk><sensors/><cameras/></chunk>", "disabled"])
def test_the_first_chunk_may_have_no_cameras(project, room, empty):
    document = ET.parse(project / "cameras.xml").getroot()
    (chunk,) = document
    first = ET.fromstring(ET.tostring(chunk) if empty == "disabled" else empty)
    if empty == "disabled":
        first.set("enabled", "false")
        first.find("sensors/sensor/calibration[@class='adjusted']/f").text = "3"
    document.insert(0, first)
    ET.ElementTree(document).write(project / "cameras.xml")
    assert choose_adapter(project).name == "metashape"
    scan = read_scan(project, OPTIONS)
    assert_same(scan, room, names=room.names)
    said = [s for s in scan.warnings if "2 chunks have cameras" in s and "'Chunk 1'" in s]
    assert len(said) == (empty == "disabled")


def test_cameras_of_one_label_are_told_apart_by_their_groups_or_left_out(project, room):
    document = ET.parse(project / "cameras.xml").getroot()
    cameras = document.find("chunk/cameras")
    for i, folder in ((6, "walk"), (7, "other")):
        (project / "images" / folder).mkdir()
        picture = project / "images" / f"DSC{i:04d}.jpg"
        picture.rename(project / "images" / folder / "DSC.jpg")
        camera = next(c for c in cameras.iter("camera") if c.get("id") == str(i))
        camera.set("label", "DSC.JPG")
    ET.ElementTree(document).write(project / "cameras.xml")
    for held in ("one picture", "no picture or several"):
        scan = read_scan(project, OPTIONS)  # both are in the group walk
        assert len(scan.frames) == 8
        (said,) = (s for s in scan.warnings if "[capture.label]" in s)
        assert "2 of 10 frames dropped, 'DSC.JPG', 'DSC.JPG': 2 cameras have this label" in said
        assert held in said
        if held == "one picture":
            (project / "images/walk").rename(project / "images/third")
    (project / "images/third").rename(project / "images/walk")
    group = cameras.find("group")
    moved = next(c for c in group if c.get("id") == "7")
    group.remove(moved)
    _child(cameras, "group", id="1", label="other").append(moved)
    ET.ElementTree(document).write(project / "cameras.xml")
    order = [*range(6), 8, 9, 7, 6]
    scan = read_scan(project, OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[order], names=room.names)


def test_a_camera_of_one_label_with_another_is_left_out_although_that_is_not_aligned(project, room):
    document = ET.parse(project / "cameras.xml").getroot()
    for camera in document.iter("camera"):
        if camera.get("id") in ("6", "7"):
            camera.set("label", "DSC0006.JPG")
        if camera.get("id") == "6":
            camera.remove(camera.find("transform"))
    ET.ElementTree(document).write(project / "cameras.xml")
    (project / "images" / "DSC0007.jpg").unlink()
    scan = read_scan(project, OPTIONS)
    assert len(scan.frames) == 8
    assert "DSC0006.jpg" not in {path.name for path in scan.frames.image_paths}
    assert any("2 cameras have this label and one picture" in said for said in scan.warnings)


def test_of_a_rig_only_the_master_has_a_transform(tmp_path, room):
    """Two cameras on one rig, at five places; the transform is the component's."""
    document, sensors, cameras = _chunk(component=True)
    _sensor(sensors, 0, **_lens(room))
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_euler("xyz", [5, 15, -20], degrees=True).as_matrix()
    offset[:3, 3] = 0.02, -0.01, 0.05
    slave = _sensor(sensors, 1, master=0, **_lens(room))
    slave.set("master_id", "0")
    _child(slave, "rotation", _text(offset[:3, :3]))
    _child(slave, "location", _text(offset[:3, 3]))
    poses = []
    for i in range(5):
        master = _in_chunk(room.opencv[2 * i])
        more = {"component_id": "5", "enabled": "true"}
        camera = _child(
            cameras, "camera", id=str(2 * i), sensor_id="0", label=f"DSC{2 * i:04d}", **more
        )
        _child(camera, "transform", _text(master))
        ids = {"id": str(2 * i + 1), "sensor_id": "1", "master_id": str(2 * i)}
        _child(cameras, "camera", label=f"DSC{2 * i + 1:04d}", **ids, **more)
        # A point of the slave goes to the master, to the chunk, to the world.
        in_world = np.eye(4)
        in_world[:3, :3], in_world[:3, 3] = SCALE * TURN, SHIFT
        second = in_world @ master @ offset
        second[:3, :3] /= SCALE
        poses += [room.world_from_camera[2 * i], second @ np.diag([1.0, -1, -1, 1])]
    scan = read_scan(_write(tmp_path / "rig", document, room), OPTIONS)
    assert_same(scan, room, poses=np.array(poses))


def _agisoft(points, kind, n):
    """Pixels of points in the camera (OpenCV's axes), as Agisoft's appendix has it."""
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    if kind == "fisheye":
        r = np.hypot(x, y)
        x, y = x * np.arctan(r) / r, y * np.arctan(r) / r
    r2 = x**2 + y**2
    bend = 1 + n["k1"] * r2 + n["k2"] * r2**2 + n["k3"] * r2**3 + n["k4"] * r2**4
    across = x * bend + n["p1"] * (r2 + 2 * x**2) + 2 * n["p2"] * x * y
    down = y * bend + n["p2"] * (r2 + 2 * y**2) + 2 * n["p1"] * x * y
    u = WIDTH * 0.5 + n["cx"] + across * n["f"] + across * n["b1"] + down * n["b2"]
    return np.stack([u, HEIGHT * 0.5 + n["cy"] + down * n["f"]], axis=1)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_lenses_image_points_where_agisofts_do(tmp_path, room, kind):
    document, sensors, cameras = _chunk()
    numbers = {
        "f": 20.0, "cx": -0.7, "cy": 0.4, "b1": 0.3, "b2": -0.2,
        "k1": -0.11, "k2": 0.05, "k3": -0.01, "k4": 0.002, "p1": 0.004, "p2": -0.006,
    }  # fmt: skip
    _sensor(sensors, 0, kind, **numbers)
    camera = _child(cameras, "camera", id="0", sensor_id="0", label="DSC0000")
    _child(camera, "transform", _text(np.eye(4)))
    folder = _write(tmp_path / "lens", document, room)
    (record,) = frame_records(
        folder / "cameras.xml", pictures_of(folder, OPTIONS), OPTIONS, Findings()
    )
    points = np.random.default_rng(0).uniform((-0.6, -0.5, 1), (0.6, 0.5, 1.2), (50, 3))
    seen = record.lens.project(points * (1, -1, -1), record.intrinsics)
    np.testing.assert_allclose(seen, _agisoft(points, kind, numbers), atol=1e-6)


def test_photoscan_has_two_focal_lengths_and_counts_from_the_corner(tmp_path, room):
    """After the manual of Agisoft Lens 0.4, whose P1 and P2 are OpenCV's, and Agisoft's own word
    that F is fy, B1 is fx - fy and B2 the skew."""
    fx, fy, cx, cy = room.intrinsics[0]
    terms = {"k1": -0.1, "k2": 0.02, "k3": -0.003, "p1": 0.004, "p2": -0.006, "skew": 0.4}
    document, sensors, cameras = _chunk()
    document.set("version", "1.1.0")
    _sensor(sensors, 0, fx=fx, fy=fy, cx=cx, cy=cy, **terms)
    for i, pose in enumerate(room.opencv):
        camera = _child(cameras, "camera", id=str(i), sensor_id="0", label=f"DSC{i:04d}")
        _child(camera, "transform", _text(_in_chunk(pose)))
    folder = _write(tmp_path / "project", document, room)
    records = frame_records(
        folder / "cameras.xml", pictures_of(folder, OPTIONS), OPTIONS, Findings()
    )
    x, y = 0.31, -0.23
    r2 = x * x + y * y
    radial = 1 - 0.1 * r2 + 0.02 * r2**2 - 0.003 * r2**3
    across = x * radial - 0.006 * (r2 + 2 * x * x) + 2 * 0.004 * x * y
    down = y * radial + 0.004 * (r2 + 2 * y * y) - 2 * 0.006 * x * y
    pixel = records[0].lens.project(np.array([x, -y, -1.0]), records[0].intrinsics)
    np.testing.assert_allclose(pixel, [cx + across * fx + down * 0.4, cy + down * fy], atol=1e-9)
    for calibration in document.iter("calibration"):
        for name in terms:
            for term in calibration.findall(name):
                calibration.remove(term)
    (tmp_path / "plain").mkdir()
    assert_same(read_scan(_write(tmp_path / "plain", document, room), OPTIONS), room)


def test_a_spherical_sensor_needs_no_calibration(tmp_path, room):
    document, sensors, cameras = _chunk()
    _sensor(sensors, 0, "spherical")
    camera = _child(cameras, "camera", id="0", sensor_id="0", label="DSC0000")
    _child(camera, "transform", _text(np.eye(4)))
    folder = _write(tmp_path / "sphere", document, room)
    (record,) = frame_records(
        folder / "cameras.xml", pictures_of(folder, OPTIONS), OPTIONS, Findings()
    )
    assert record.lens.curve == "equirectangular"
    ahead = record.lens.project(np.array([[0.0, 0, -1], [1, 0, 0]]), record.intrinsics)
    np.testing.assert_allclose(ahead, [[WIDTH / 2, HEIGHT / 2], [0.75 * WIDTH, HEIGHT / 2]])


def test_undistorted_pictures_do_not_go_with_the_lens(tmp_path, room):
    document, sensors, cameras = _chunk()
    _sensor(sensors, 0, **_lens(room), k1=-0.1)
    for i, pose in enumerate(room.opencv):
        camera = _child(cameras, "camera", id=str(i), sensor_id="0", label=f"DSC{i:04d}")
        _child(camera, "transform", _text(_in_chunk(pose)))
    folder = _write(tmp_path / "project", document, room)
    (folder / "model.jpg").write_bytes(b"a texture")  # before model.obj, and no mesh
    assert len(read_scan(folder, OPTIONS).views) == len(room.images)
    (folder / "images").rename(folder / "undistorted")
    with pytest.raises(InputRefused, match=r"has been undistorted.*\[capture.camera\]"):
        read_scan(folder, OPTIONS)


def test_groups_tell_pictures_of_one_name_apart(tmp_path, room):
    document, sensors, cameras = _chunk()
    _sensor(sensors, 0, **_lens(room))
    for side in range(2):
        group = _child(cameras, "group", id=str(side), label=f"camera {side}", type="folder")
        for i, pose in list(enumerate(room.opencv))[side::2]:
            camera = _child(group, "camera", id=str(i), sensor_id="0", label=f"{i // 2}")
            _child(camera, "transform", _text(_in_chunk(pose)))
    folder = _write(tmp_path / "project", document, room)
    for i in range(len(room.images)):
        place = folder / "images" / f"camera {i % 2}" / f"{i // 2}.jpg"
        place.parent.mkdir(exist_ok=True)
        (folder / "images" / f"DSC{i:04d}.jpg").rename(place)
    scan = read_scan(folder, OPTIONS)
    assert_same(scan, room, poses=room.world_from_camera[[*range(0, 10, 2), *range(1, 10, 2)]])


def _edit(change):
    def damage(project):
        tree = ET.parse(project / "cameras.xml")
        change(tree.getroot())
        tree.write(project / "cameras.xml")

    return damage


def _no_model(project):
    (project / "model.obj").unlink()


def _no_pictures(project):
    for path in project.glob("images/*"):
        path.unlink()


def _not_aligned(root):
    for camera in list(root.iter("camera"))[:4]:
        camera.remove(camera.find("transform"))


def _disabled(root):
    for camera in root.iter("camera"):
        camera.set("enabled", "0")


def _not_calibrated(root):
    (sensor,) = root.iter("sensor")
    for calibration in sensor.findall("calibration"):
        sensor.remove(calibration)


def _cylindrical(root):
    for each in [*root.iter("sensor"), *root.iter("calibration")]:
        each.set("type", "cylindrical")


def _higher_terms(root):
    _child(list(root.iter("calibration"))[1], "p3", "0.1")


def _without_cameras(root):
    root.find("chunk").remove(root.find("chunk/cameras"))


def _georeferenced(root):
    root.find("chunk/transform/translation").text = "4157222.5 664789.3 4774952.1"


def _exported_twice(project):
    (project / "before.xml").write_bytes((project / "cameras.xml").read_bytes())


def _entities(project):
    text = (project / "cameras.xml").read_text()
    text = text.replace("?>", '?><!DOCTYPE d [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]>', 1)
    (project / "cameras.xml").write_text(text)


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (_no_model, r"no mesh\. Export the model .*--mesh\. \[mesh.missing\]"),
        (_no_pictures, r"no pictures below.*--frames\. \[capture.frames\]"),
        (_edit(_not_aligned), r"only 6 of 10.*not been aligned.*Align and.*\[capture.alignment\]"),
        (_edit(_disabled), r"all of its 10 cameras are disabled\. Enable .*\[capture.alignment\]"),
        (_edit(_not_calibrated), r"only 0 of 10.*sensor is not calibrated.*\[capture.alignment\]"),
        (_edit(_cylindrical), r"a 'cylindrical' camera.*\[capture.camera\]"),
        (_edit(_higher_terms), r"'camera 0' has .*higher tangential terms.*\[capture.camera\]"),
        (_edit(_without_cameras), r"no chunk with sensors and cameras.*\[capture.format\]"),
        (_edit(_georeferenced), r"georeferenced.* 6366 km.*Local Coordinates.*\[capture.pose\]"),
        (_exported_twice, r"2 exports of cameras.*Name the file.*\[capture.format\]"),
        (_entities, r"document type.*\[document.xml\]"),
    ],
)
def test_refusals(project, damage, sentence):
    damage(project)
    with pytest.raises(InputRefused, match=sentence):
        read_scan(project, OPTIONS, "metashape")


def test_a_folder_of_two_exports_is_one_of_metashape(project):
    _exported_twice(project)
    assert choose_adapter(project).name == "metashape"


def _write_region(project, room, times=1.1):
    """As Metashape writes it: centre, size and axes of a box in the chunk's coordinates, so many
    times as large as the room."""
    document = ET.parse(project / "cameras.xml")
    points = (room.points - SHIFT) @ TURN / SCALE
    axes = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    inner = points @ axes
    low, high = inner.min(axis=0), inner.max(axis=0)
    region = _child(document.getroot().find("chunk"), "region")
    _child(region, "center", _text(axes @ (low + high) / 2))
    _child(region, "size", _text((high - low) * times))
    _child(region, "R", _text(axes))
    document.write(project / "cameras.xml")


@pytest.mark.parametrize("unit", [1.0, SCALE])
def test_a_model_in_the_chunks_own_coordinates_is_brought_to_the_cameras(project, room, unit):
    """Rays were said to miss it, or to hit one in another unit; or it was taken as it lay."""
    _write_region(project, room)
    write_obj(project / "model.obj", room, (room.points - SHIFT) @ TURN / SCALE * unit)
    scan = read_scan(project, OPTIONS)
    assert_same(scan, room, names=room.names)
    (said,) = (said for said in scan.warnings if "[mesh.frame]" in said)
    assert f"{SCALE / unit:.3g} times as large" in said


def test_a_model_where_the_transform_leads_stays_there(project, room):
    _write_region(project, room)
    scan = read_scan(project, OPTIONS)
    assert_same(scan, room, names=room.names)
    assert not any("[mesh.frame]" in said for said in scan.warnings)


@pytest.mark.parametrize(("size", "times"), [(0.3, 0.33), (0.3, 1.2), (0.1, 0.4), (1.0, 4.0)])
def test_a_thing_before_the_cameras_stays_as_large_as_it_is(project, room, size, times):
    """A larger one would be hit by more of their rays."""
    middle = room.points.mean(axis=0)
    points = middle + size * (room.points - middle)
    _write_region(project, room, times)
    write_obj(project / "model.obj", room, points)
    scan = read_scan(project, OPTIONS)
    assert not any("[mesh.frame]" in said for said in scan.warnings)
    np.testing.assert_allclose(np.ptp(scan.mesh.points, axis=0), np.ptp(points, axis=0), rtol=1e-5)


def test_a_georeferenced_chunk_has_its_model_in_its_own_coordinates(project, room):
    """In which the cameras are read then, in metres, z up."""
    _write_region(project, room)
    document = ET.parse(project / "cameras.xml")
    up = np.array([4157222.5, 664789.3, 4774952.1])
    document.getroot().find("chunk/transform/translation").text = _text(up)
    document.write(project / "cameras.xml")
    write_obj(project / "model.obj", room, (room.points - SHIFT) @ TURN / SCALE)
    scan = read_scan(project, OPTIONS)
    up, east = up / np.linalg.norm(up), np.cross([0, 0, 1], up)
    east /= np.linalg.norm(east)
    turn = np.stack([east, np.cross(up, east), up])
    poses = room.world_from_camera.copy()
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    poses[:, :3, 3] = (poses[:, :3, 3] - SHIFT) @ turn.T
    assert_same(scan, room, points=(room.points - SHIFT) @ turn.T, poses=poses, names=room.names)


@pytest.mark.parametrize("name", ["IMAGES", "Photos K\u00fcche", "day 1/DCIM/100CANON"])
def test_pictures_are_found_in_the_only_folder_that_holds_any(project, room, name):
    (project / "images").rename(project / "moved")
    (project / name).parent.mkdir(parents=True, exist_ok=True)
    (project / "moved").rename(project / name)
    write_image(project / "Masks_" / "DSC0000.png", np.ones((HEIGHT, WIDTH, 3), np.float32))
    (project / "empty").mkdir()
    assert_same(read_scan(project, OPTIONS), room, names=room.names)


def test_of_two_folders_nobody_knows_which_holds_the_pictures(project):
    (project / "images").rename(project / "one")
    write_image(project / "two" / "DSC0000.jpg", np.ones((HEIGHT, WIDTH, 3), np.float32))
    with pytest.raises(InputRefused, match=r"no pictures below .*--frames\. \[capture.frames\]"):
        read_scan(project, OPTIONS)


@pytest.mark.parametrize("whole", [True, False])
def test_links_to_pictures_elsewhere_say_how_to_name_these(project, room, tmp_path, whole):
    """That there were none was told, or to put the file inside."""
    (project / "images").rename(tmp_path / "card")
    if whole:
        (project / "images").symlink_to(tmp_path / "card")
    else:
        (project / "images").mkdir()
        for file in (tmp_path / "card").iterdir():
            (project / "images" / file.name).symlink_to(file)
    with pytest.raises(InputRefused, match="Name the folder that the pictures themselves lie in"):
        read_scan(project, OPTIONS)
    given = replace(OPTIONS, frames=tmp_path / "card")
    assert_same(read_scan(project, given), room, names=room.names)
