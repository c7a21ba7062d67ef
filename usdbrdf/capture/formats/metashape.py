"""Metashape's cameras as XML (File > Export > Export Cameras), pictures and the exported model.

A camera's transform is from the camera (OpenCV's axes) to the chunk; the chunk's transform leads on
to the frame of exported models. Of a rig, only the master has a transform: the others stand as
their sensors say, seen from the master's. Principal points are offsets from the picture's middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    drop_without_picture,
    mask_beside,
    mesh_beside,
    opengl_from_opencv,
    pictures_of,
    refuse_without_pictures,
    rigid_pose,
    scan_of,
    up_axis_of,
    warn_of_unused,
)
from usdbrdf.errors import InputRefused
from usdbrdf.files.tables import Element, beginning_of, number_in, numbers_of, read_xml
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens, whole_sphere
from usdbrdf.options import IngestOptions

NAME = "metashape"
DESCRIPTION = DESCRIPTIONS[NAME]
_CURVES = {"frame": "perspective", "fisheye": "fisheye", "equidistant_fisheye": "fisheye"}


def matches(path: Path) -> bool:
    """An XML document with sensors and cameras, or a folder with one of them."""
    return len(_documents(path)) == 1


def _documents(path: Path) -> list[Path]:
    files = sorted(path.glob("*.xml")) if path.is_dir() else [path]
    heads = ((file, beginning_of(file)) for file in files if file.suffix.lower() == ".xml")
    return [file for file, head in heads if b"<chunk" in head and b"<sensors" in head]


def read(path: Path, options: IngestOptions) -> Scan:
    documents = _documents(path.resolve())
    if len(documents) != 1:
        said = f"{len(documents)} exports of cameras" if documents else "no export of cameras"
        raise InputRefused(
            f"{path}: {said} (XML with sensors and cameras). Name the file, which File > Export > "
            "Export Cameras writes. [capture.format]"
        )
    (source,) = documents
    folder, findings = source.parent, Findings()
    pictures = pictures_of(folder, options)
    refuse_without_pictures(pictures, source)
    records = frame_records(source, pictures, findings)
    warn_of_unused(pictures, (r.image_path for r in records), findings, source)
    mesh = mesh_beside(
        folder,
        options,
        "mesh.*",
        "model.*",
        how="Export the model (File > Export > Export Model) in the coordinate system of the "
        "cameras into this folder",
    )
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        up_axis=up_axis_of(records),
    )


@dataclass(frozen=True, kw_only=True)
class _Sensor:
    """A calibrated camera; ``master_from_sensor`` (4, 4) in the chunk's unit, for rigs."""

    intrinsics: tuple[float, float, float, float]
    resolution: tuple[int, int]
    lens: Lens
    master_from_sensor: Double


@dataclass(frozen=True, kw_only=True)
class _Place:
    """x_world = scale * rotation x + translation, of a chunk or of a component of it."""

    rotation: Double
    translation: Double
    scale: float

    def pose(self, chunk_from_camera: Double) -> Double:
        """(4, 4) world from camera, rigid."""
        centre = self.scale * self.rotation @ chunk_from_camera[:3, 3] + self.translation
        return rigid_pose(self.rotation @ chunk_from_camera[:3, :3], centre)


def frame_records(source: Path, pictures: Pictures, findings: Findings) -> list[FrameRecord]:
    """The cameras of a document that have a pose and a picture, by their labels."""
    chunk = read_xml(source).find("chunk")
    if chunk is None or chunk.find("sensors") is None or chunk.find("cameras") is None:
        raise InputRefused(
            f"{source}: no chunk with sensors and cameras. Export the cameras again. "
            "[capture.format]"
        )
    sensors = {
        s.get("id", ""): found
        for s in chunk.iterfind("sensors/sensor")
        if (found := _sensor(s, source))
    }
    own = _place(chunk.find("transform"))
    components = {
        c.get("id", ""): _place(c.find("transform")) for c in chunk.iterfind("components/component")
    }
    if own is None and not any(components.values()):
        findings.warn(
            f"{source.name}: the chunk has no transform, so its unit is arbitrary. State "
            "--meters-per-unit. [capture.unit]"
        )
    cameras = list(chunk.iterfind("cameras//camera"))
    chunk_from_camera = {c.get("id", ""): numbers_of(c.find("transform"), 16) for c in cameras}
    records = []
    for camera in cameras:
        label = camera.get("label", "")
        if camera.get("enabled", "true").lower() in ("false", "0"):
            findings.count("cameras_disabled", 1)
            continue
        sensor = sensors.get(camera.get("sensor_id", ""))
        master = chunk_from_camera.get(camera.get("master_id", camera.get("id", "")))
        if sensor is None or master is None:
            why = "its sensor is not calibrated" if sensor is None else "it has not been aligned"
            findings.drop(label, why, "capture.pose")
            continue
        image = pictures.named(label)
        if image is None:
            drop_without_picture(label, findings)
            continue
        place = own or components.get(camera.get("component_id", "")) or _UNPLACED
        pose = place.pose(master.reshape(4, 4) @ sensor.master_from_sensor)
        records.append(
            FrameRecord(
                name=label,
                image_path=image,
                world_from_camera=opengl_from_opencv(pose),
                intrinsics=sensor.intrinsics,
                resolution=sensor.resolution,
                lens=sensor.lens,
                mask_path=mask_beside(source.parent, image),
            )
        )
    return sorted(records, key=lambda record: record.image_path)


_UNPLACED = _Place(rotation=np.eye(3), translation=np.zeros(3), scale=1.0)


def _place(transform: Element | None) -> _Place | None:
    if transform is None:
        return None
    rotation = numbers_of(transform.find("rotation"), 9)
    translation = numbers_of(transform.find("translation"), 3)
    scale = numbers_of(transform.find("scale"), 1)
    return _Place(
        rotation=np.eye(3) if rotation is None else rotation.reshape(3, 3),
        translation=np.zeros(3) if translation is None else translation,
        scale=1.0 if scale is None else float(scale[0]),
    )


def _sensor(sensor: Element, source: Path) -> _Sensor | None:
    """A sensor that is calibrated (or needs no calibration, because it sees a whole sphere)."""
    kind = sensor.get("type", "frame")
    calibrations = {c.get("class", ""): c for c in sensor.iterfind("calibration")}
    adjusted = calibrations.get("adjusted", next(iter(calibrations.values()), None))
    size = sensor.find("resolution")
    if adjusted is not None and adjusted.find("resolution") is not None:
        size = adjusted.find("resolution")
    rotation = numbers_of(sensor.find("rotation"), 9)
    location = numbers_of(sensor.find("location"), 3)
    offset = rigid_pose(
        np.eye(3) if rotation is None else rotation.reshape(3, 3),
        np.zeros(3) if location is None else location,
    )
    # A master stands where its cameras do, even where its own offset is written down.
    if sensor.get("master_id") is None:
        offset = np.eye(4)
    sides = (
        [number_in(size.attrib, side) for side in ("width", "height")] if size is not None else []
    )
    if not all(side and side >= 1 for side in sides):
        return None
    width, height = (int(side or 0) for side in sides)
    if kind == "spherical":
        return _Sensor(
            intrinsics=whole_sphere(width, height),
            resolution=(width, height),
            lens=Lens(curve="equirectangular"),
            master_from_sensor=offset,
        )
    if adjusted is None:
        return None
    kind = adjusted.get("type", kind)
    if kind not in _CURVES:
        raise InputRefused(
            f"{source}: the sensor {sensor.get('label', '')!r} is a {kind!r} camera (known: "
            f"{', '.join(_CURVES)}, spherical). Undistort the pictures in Metashape and export the "
            "cameras again. [capture.camera]"
        )
    said = {name: _number(adjusted, name) for name in _NUMBERS}
    focal = said["f"]
    if not focal > 0 or said["p3"] or said["p4"]:
        raise InputRefused(
            f"{source}: the calibration of sensor {sensor.get('label', '')!r} has no focal length, "
            "or higher tangential terms (P3, P4), which are not read. Correct it, or optimise the "
            "cameras without these. [capture.camera]"
        )
    across = focal + said["b1"]
    radial = tuple(said[f"k{i}"] for i in range(1, 5))
    lens = Lens(
        curve="fisheye" if _CURVES[kind] == "fisheye" else "perspective",
        radial=radial,
        tangential=(said["p2"], said["p1"]),  # the other way round than OpenCV
        skew=said["b2"] / across,
    )
    return _Sensor(
        intrinsics=(across, focal, width / 2 + said["cx"], height / 2 + said["cy"]),
        resolution=(width, height),
        lens=lens if lens.bends else PINHOLE,
        master_from_sensor=offset,
    )


_NUMBERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def _number(adjusted: Element, name: str) -> float:
    """A number of a calibration; what is not there is 0."""
    value = numbers_of(adjusted.find(name), 1)
    return 0.0 if value is None else float(value[0])
