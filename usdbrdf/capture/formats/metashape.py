"""Metashape's cameras as XML (File > Export > Export Cameras), pictures and the exported model.

A camera's transform is from the camera (OpenCV's axes) to the chunk; the chunk's transform leads on
to the frame of exported models. Of a rig, only the master has a transform: the others stand as
their sensors say, seen from the master's. Principal points are offsets from the picture's middle;
PhotoScan before 1.2 wrote fx, fy and skew, the principal point from the corner, and P1 and P2 as
OpenCV has them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.camera_checks import hit_share, warn_of_rolling_shutter, with_doubts_about_unit
from usdbrdf.capture.checks import Findings, FrameRecord, frames_from_records
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    drop_without_picture,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
    warn_of_unused,
)
from usdbrdf.capture.mesh_frames import mesh_beside, moved_geometry
from usdbrdf.capture.parts import geometry_from_file
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.capture.up_axis import up_axis_assumed
from usdbrdf.errors import InputRefused
from usdbrdf.files.tables import (
    Element,
    beginning_of_text,
    files_of,
    number_in,
    numbers_of,
    only_one,
    read_xml,
)
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Curve, Lens, whole_sphere
from usdbrdf.model.mesh import ScanGeometry
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.mesh_files import SUFFIXES as MESH_SUFFIXES
from usdbrdf.untrusted.mesh_files import mesh_from_file

NAME = "metashape"
DESCRIPTION = DESCRIPTIONS[NAME]
_CURVES: dict[str, Curve] = {
    "frame": "perspective",
    "fisheye": "fisheye",
    "equidistant_fisheye": "fisheye",
}
# From the Earth's middle, in metres: nothing stands so far from the origin of its own coordinates.
_GEOCENTRIC = 1e6
# Of rays that hit a mesh where it is seen.
_SEEN = 0.2
# Of a mesh's vertices that lie in the region of its chunk, made larger; and of its size.
_INSIDE, _SLACK, _FILLED = 0.9, 1.05, 0.2


def matches(path: Path) -> bool:
    """An XML document with sensors and cameras, or a folder with such."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    heads = ((file, beginning_of_text(file)) for file in files_of(path, [".xml"]))
    return [file for file, head in heads if "<chunk" in head and "<sensors" in head]


def read(path: Path, options: CaptureOptions) -> Scan:
    called = "exports of cameras (XML with sensors and cameras)"
    how = "Name the file, which File > Export > Export Cameras writes"
    source = only_one(_documents(path.resolve()), path, called, how)
    folder, findings = source.parent, Findings()
    pictures = pictures_of(folder, options)
    refuse_without_pictures(pictures, source)
    records = frame_records(source, pictures, options, findings)
    warn_of_radiance(pictures.instead, findings, source)
    warn_of_unused(pictures, (r.image_path for r in records), findings, source)
    scan = scan_of(
        records,
        partial(_geometry, source, folder, records, options, findings),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        up_axis=up_axis_assumed(records, options, findings, source.name),
    )
    # Geocentric coordinates are in metres.
    place = _place(_chunk(read_xml(source), source, Findings()).find("transform"))
    stated = scan.usd_geometry is not None or (place is not None and _near(place) is not place)
    return with_doubts_about_unit(scan, options, stated=stated)


# (3, 3) and (3,) from a chunk to a cube of -1 to 1, which holds its model; its sizes (3,) there.
_Region = tuple[Double, Double, Double]


def _geometry(
    source: Path,
    folder: Path,
    records: Sequence[FrameRecord],
    options: CaptureOptions,
    findings: Findings,
) -> ScanGeometry:
    """The mesh in the frame of the cameras, also if it was exported in the chunk's."""
    how = "Export the model (File > Export > Export Model) in the cameras' coordinates to here"
    mesh = mesh_beside(folder, options, "mesh.*", "model.*", how=how)

    def read(own: CaptureOptions) -> ScanGeometry:
        return geometry_from_file(mesh, own.objects, own, findings, capture_root=folder)

    chunk = _chunk(read_xml(source), source, Findings())
    placed = chunk.find("components/component[transform]")
    holder = chunk if placed is None else placed
    own, region = _place(holder.find("transform")), _region(holder)
    one = len(chunk.findall("components/component")) < 2 and mesh.suffix.lower() in MESH_SUFFIXES
    found = _exported_in(mesh, own, region, records) if own and region and one else None
    if own is None or found is None:
        _refuse_geocentric(own, source)
        return read(options)
    place, (scale, said) = _near(own), found
    findings.warn(
        f"{mesh.name}: lies in {said}, not where its transform leads, by where the cameras see it; "
        f"it is brought to the cameras, {place.scale / scale:.3g} times as large. [mesh.frame]"
    )
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([place.rotation * (place.scale / scale), place.translation])
    return moved_geometry(read, matrix, options, 1.0)


def _exported_in(
    mesh: Path, own: _Place, region: _Region, records: Sequence[FrameRecord]
) -> tuple[float, str] | None:
    """Where a mesh lies that is not in the world: how much larger the chunk's coordinates are
    there, and its name. Cameras must see it there, and it must lie in the chunk's region and
    fill it; None where it does so in the world, or nobody knows."""
    place = _near(own)
    flat = [r for r in records if r.lens.curve != "equirectangular"]
    frames = frames_from_records(flat, encoding="lin_rec709_scene", radiometric=True)
    whole = mesh_from_file(mesh)
    points = whole.points.astype(np.float64)
    used = points[np.unique(whole.triangles)]
    size = float(np.linalg.norm(np.ptp(used, axis=0)))

    def hits(there: Double) -> float:
        return hit_share(there.astype(np.float32), whole.triangles, frames) if flat else 0.0

    def fits(inner: Double, length: float) -> bool:
        return length > _FILLED * float(np.linalg.norm(region[2])) and _lies_in(region, inner)

    # What is larger is hit by more rays: a thing that any ray hits in the world stays there.
    inner = (used - place.translation) @ place.rotation / place.scale
    if place is own and fits(inner, size / place.scale) and hits(points) > 0:
        return None
    best, least = None, _SEEN
    known = {1.0: "the chunk's own coordinates", place.scale: "the chunk's own axes in its unit"}
    for scale, said in known.items():
        if fits(used / scale, size / scale):
            share = hits(points @ place.rotation.T * (place.scale / scale) + place.translation)
            if share >= least:
                best, least = (scale, said), share
    return best


def _region(chunk: Element) -> _Region | None:
    """Where the chunk's model lies; None where the document does not say."""
    holder = chunk.find("region")
    if holder is None:
        return None
    centre, size = numbers_of(holder.find("center"), 3), numbers_of(holder.find("size"), 3)
    turn = numbers_of(holder.find("R"), 9)
    if centre is None or size is None or not (size > 0).all():
        return None
    axes = (np.eye(3) if turn is None else turn.reshape(3, 3)).T / (size[:, None] / 2)
    return axes, -axes @ centre, size


def _lies_in(region: _Region, points: Double) -> bool:
    """Whether nearly all points (N, 3) of the chunk lie in its region."""
    inner = points @ region[0].T + region[1]
    return bool((np.abs(inner) <= _SLACK).all(axis=1).mean() >= _INSIDE)


def _near(place: _Place) -> _Place:
    """A place; of one that leads to geocentric coordinates what stands at the origin, z up."""
    if _distance(place) <= _GEOCENTRIC:
        return place
    up = place.translation / _distance(place)
    east = np.cross([0.0, 0, 1], up)
    east = east / np.linalg.norm(east) if np.linalg.norm(east) > 0 else np.array([1.0, 0, 0])
    axes = np.stack([east, np.cross(up, east), up])
    return _Place(rotation=axes @ place.rotation, translation=np.zeros(3), scale=place.scale)


def _refuse_geocentric(place: _Place | None, source: Path) -> None:
    if place and (far := _distance(place)) > _GEOCENTRIC:
        raise InputRefused(
            f"{source}: the chunk is georeferenced: its transform leads {far / 1000:.0f} km away, "
            "to geocentric coordinates, in which no model is exported, and the mesh does not lie "
            "in the chunk's own. Make its coordinate system Local Coordinates (Reference > "
            "Settings), update the transform, and export cameras and model again. [capture.pose]"
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


def frame_records(
    source: Path, pictures: Pictures, options: CaptureOptions, findings: Findings
) -> list[FrameRecord]:
    """The cameras of a document that have a pose and a picture, by their labels."""
    chunk = _chunk(read_xml(source), source, findings)
    sensors = {s.get("id", ""): _sensor(s, source) for s in chunk.iterfind("sensors/sensor")}
    place_of = _places(chunk, source, findings)
    cameras = list(chunk.iterfind("cameras//camera"))
    if cameras and not any(map(_is_enabled, cameras)):
        raise InputRefused(
            f"{source}: all of its {len(cameras)} cameras are disabled. Enable them in Metashape, "
            "and export the cameras again. [capture.alignment]"
        )
    # Pictures of one name in several folders are told apart by the groups that they are in.
    group_of = {c: g.get("label", "") for g in chunk.iterfind("cameras/group") for c in g}
    chunk_from_camera = {c.get("id", ""): numbers_of(c.find("transform"), 16) for c in cameras}
    shared = Counter(camera.get("label", "") for camera in filter(_is_enabled, cameras))
    # Those that are not aligned too: the picture may be theirs.
    picture_of = {
        camera: pictures.named(f"{group_of.get(camera, '')}/{label}") or pictures.named(label)
        for camera in filter(_is_enabled, cameras)
        if (label := camera.get("label", ""))
    }
    cameras_of = Counter(picture_of.values())
    used, records = [], []
    for camera in cameras:
        label = camera.get("label", "")
        if not _is_enabled(camera):
            findings.count("cameras_disabled", 1)
            continue
        sensor = sensors.get(camera.get("sensor_id", ""))
        master = chunk_from_camera.get(camera.get("master_id", camera.get("id", "")))
        if sensor is None or master is None:
            why = "its sensor is not calibrated" if sensor is None else "it has not been aligned"
            findings.drop(label, why, "capture.alignment")
            continue
        place = place_of(camera)
        if place is None:
            named = camera.get("component_id")
            said = f"its component {named!r} stands nowhere among the others"
            if named is None:
                said = "it names no component, of which there are several"
            findings.drop(label, said, "capture.alignment")
            continue
        image = picture_of.get(camera)
        if image is None and shared[label] > 1:
            said = f"{shared[label]} cameras have this label, and no picture or several this name"
            findings.drop(label, said, "capture.label")
            continue
        if image is None:
            drop_without_picture(label, findings)
            continue
        if cameras_of[image] > 1:
            said = (
                f"{cameras_of[image]} cameras have this label and one picture, which may be of any"
            )
            findings.drop(label, said, "capture.label")
            continue
        used.append(camera)
        pose = place.pose(master.reshape(4, 4) @ sensor.master_from_sensor)
        records.append(
            FrameRecord(
                name=label,
                image_path=image,
                world_from_camera=opengl_from_opencv(pose),
                intrinsics=sensor.intrinsics,
                resolution=sensor.resolution,
                lens=sensor.lens,
                mask_path=pictures.mask_of(image, source.parent, options),
            )
        )
    used_sensors = {camera.get("sensor_id", "") for camera in used}
    used += [s for s in chunk.iterfind("sensors/sensor") if s.get("id", "") in used_sensors]
    if any(_moves_while_it_reads(part) for element in used for part in element.iter()):
        warn_of_rolling_shutter(source, findings)
    return sorted(records, key=lambda record: record.image_path)


def _chunk(document: Element, source: Path, findings: Findings) -> Element:
    """The first chunk that has cameras, of those that are enabled if one of these has."""
    chunks = list(document.iterfind("chunk"))
    full = [
        c for c in chunks if c.find("sensors") is not None and c.find("cameras//camera") is not None
    ]
    if not full:
        held = "no chunk" if len(chunks) < 2 else f"{len(chunks)} chunks, but none"
        raise InputRefused(
            f"{source}: {held} with sensors and cameras. Make the chunk with the aligned cameras "
            "the active one, and export the cameras again. [capture.format]"
        )
    chosen = next(filter(_is_enabled, full), full[0])
    if len(full) > 1:
        findings.warn(
            f"{source.name}: {len(full)} chunks have cameras; those of the chunk "
            f"{chosen.get('label', '')!r} are read. Export the chunk of the model alone if that is "
            "another. [capture.chunk]"
        )
    return chosen


def _is_enabled(camera: Element) -> bool:
    return camera.get("enabled", "true").lower() not in ("false", "0")


def _moves_while_it_reads(element: Element) -> bool:
    """Whether an element is the motion that a rolling shutter was compensated for, of a camera or,
    as what its sensor has, for all: of none numbers are 0, and words say so."""
    if not element.tag.startswith("rolling_shutter"):
        return False
    said = " ".join([*element.itertext(), *element.attrib.values()]).lower().split()
    return any(word not in ("false", "none", "disabled") and word.strip("0.e+-") for word in said)


def _places(chunk: Element, source: Path, findings: Findings) -> Callable[[Element], _Place | None]:
    """Where a camera's component stands, as it says itself, else the chunk; None of one that was
    not aligned with the others. Where none is placed the largest has its own coordinates."""
    own = _place(chunk.find("transform"))
    parts = chunk.iterfind("components/component")
    components = {part.get("id", ""): _place(part.find("transform")) for part in parts}
    if len(components) > 1:
        for place in components.values():
            _refuse_geocentric(place, source)
    components = {number: place and _near(place) for number, place in components.items()}
    own = own and _near(own)
    if own is None and not any(components.values()):
        findings.warn(
            f"{source.name}: the chunk has no transform, so its unit is arbitrary. State "
            "--meters-per-unit. [capture.unit]"
        )
    held = Counter(
        camera.get("component_id", "")
        for camera in chunk.iterfind("cameras//camera")
        if camera.find("transform") is not None and _is_enabled(camera)
    )
    largest = max(held, key=held.__getitem__, default="")
    is_placed = own is not None or any(components.values())

    def place_of(camera: Element) -> _Place | None:
        component = camera.get("component_id", "")
        if place := components.get(component) or own:
            return place
        if component not in components and is_placed:
            # Cameras that name no component are of the only one, if there is but one.
            return (
                next(iter(components.values())) if len(components) == 1 and not component else None
            )
        alone = not is_placed and component in (largest, "")
        return _UNPLACED if alone or component not in components else None

    return place_of


def _distance(place: _Place) -> float:
    return float(np.linalg.norm(place.translation))


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
    calibrations = {c.get("class", ""): c for c in sensor.iterfind("calibration")}
    adjusted = calibrations.get("adjusted", next(iter(calibrations.values()), None))
    resolution = _resolution(adjusted) or _resolution(sensor)
    if resolution is None:
        return None
    if sensor.get("type") == "spherical":
        return _Sensor(
            intrinsics=whole_sphere(*resolution),
            resolution=resolution,
            lens=Lens(curve="equirectangular"),
            master_from_sensor=_offset(sensor),
        )
    if adjusted is None:
        return None
    named = f"{source}: the sensor {sensor.get('label', '')!r}"
    kind = adjusted.get("type", sensor.get("type", "frame"))
    if kind not in _CURVES:
        raise InputRefused(
            f"{named} is a {kind!r} camera (known: {', '.join(_CURVES)}, spherical). Undistort the "
            "pictures in Metashape and export the cameras again. [capture.camera]"
        )
    said = _of_photoscan(adjusted, resolution) or {n: _number(adjusted, n) for n in _NUMBERS}
    focal, across = said["f"], said["f"] + said["b1"]
    if not min(focal, across) > 0 or said["p3"] or said["p4"]:
        raise InputRefused(
            f"{named} has no focal length, or higher tangential terms (P3, P4), which are not "
            "read. Correct it, or optimise the cameras without these. [capture.camera]"
        )
    lens = Lens(
        curve=_CURVES[kind],
        radial=tuple(said[f"k{i}"] for i in range(1, 5)),
        tangential=(said["p2"], said["p1"]),  # the other way round than OpenCV
        skew=said["b2"] / across,
    )
    middle = resolution[0] / 2, resolution[1] / 2
    return _Sensor(
        intrinsics=(across, focal, middle[0] + said["cx"], middle[1] + said["cy"]),
        resolution=resolution,
        lens=lens if lens.bends else PINHOLE,
        master_from_sensor=_offset(sensor),
    )


def _resolution(holder: Element | None) -> tuple[int, int] | None:
    size = holder.find("resolution") if holder is not None else None
    width, height = (number_in(size.attrib if size is not None else {}, s) for s in _SIDES)
    return (int(width), int(height)) if width and height and min(width, height) >= 1 else None


def _offset(sensor: Element) -> Double:
    """(4, 4) from the sensor to its rig's master. A master stands where its cameras do, even where
    an offset of its own is written down."""
    rotation = numbers_of(sensor.find("rotation"), 9)
    location = numbers_of(sensor.find("location"), 3)
    if sensor.get("master_id") is None:
        return np.eye(4)
    return rigid_pose(
        np.eye(3) if rotation is None else rotation.reshape(3, 3),
        np.zeros(3) if location is None else location,
    )


_SIDES = ("width", "height")
_NUMBERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")


def _of_photoscan(adjusted: Element, resolution: tuple[int, int]) -> dict[str, float] | None:
    """The numbers of a calibration with fx and fy, as those of Metashape; None of another."""
    if adjusted.find("fx") is None:
        return None
    old = {name: _number(adjusted, name) for name in ("fx", "fy", "skew", *_NUMBERS)}
    width, height = resolution
    return old | {
        "f": old["fy"], "b1": old["fx"] - old["fy"], "b2": old["skew"],
        "cx": old["cx"] - width / 2, "cy": old["cy"] - height / 2,
        "p1": old["p2"], "p2": old["p1"],
    }  # fmt: skip


def _number(adjusted: Element, name: str) -> float:
    """A number of a calibration; what is not there is 0."""
    value = numbers_of(adjusted.find(name), 1)
    return 0.0 if value is None else float(value[0])
