"""Open Photogrammetry Format, as PIX4Dmatic exports it: NAME.opf, which lists what there is; of
that the pictures, their sensors, and the calibrated cameras; a mesh beside, in their frame.

A camera's place and its angles, of R_x R_y R_z from its axes (OpenGL's) to the world, are in the
project's processing frame, near its origin. Lenses are Pix4D's; the picture's corner is (0, 0).
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.camera_checks import warn_of_rolling_shutter
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.mesh_frames import path_in_capture
from usdbrdf.capture.reconstructions.shots import Shot, ShotCamera, rows_of, scan_of_shots
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.tables import beginning_of, files_of, number_in, numbers_among, only_one
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens, fisheye_of_turn, is_fisheye_of_turn, whole_sphere
from usdbrdf.options import CaptureOptions

NAME = "opf"
DESCRIPTION = DESCRIPTIONS[NAME]
_PROJECT = b'"application/opf-project+json"'
_PICTURES, _SENSORS, _CAMERAS, _FRAME = (
    f"application/opf-{name}+json"
    for name in ("camera-list", "input-cameras", "calibrated-cameras", "scene-reference-frame")
)
# Of a coordinate system in WKT each unit but angles', and how many metres it is. UNIT alone may be
# either, so that a text with one tells nothing certain.
_UNIT = re.compile(r'\b(?:LENGTH)?UNIT\s*[\[(]\s*"[^"]*"\s*,\s*([^\s,\])]+)', re.IGNORECASE)


def matches(path: Path) -> bool:
    """Such a project, or a folder with one."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    return [file for file in files_of(path, [".opf"]) if _PROJECT in beginning_of(file)]


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    source = only_one(documents, path, "projects .opf", "Name the one of the calibration")
    lists, sensors, cameras, frames = (
        _resources(source, kind, options) for kind in (_PICTURES, _SENSORS, _CAMERAS, _FRAME)
    )
    if not cameras or not lists:
        raise InputRefused(
            f"{source}: it names no calibrated cameras with a list of their pictures. Calibrate "
            "the project, and export it as OPF again. [capture.alignment]"
        )
    if len(cameras) > 1:
        findings.warn(
            f"{source.name}: {len(cameras)} calibrations; the first is read. [capture.format]"
        )
    moved = (numbers_among(row.get("rolling_shutter"), 3) for row in rows_of(cameras[0], "cameras"))
    if any(numbers is not None and numbers.any() for numbers in moved):
        warn_of_rolling_shutter(source, findings)
    systems = [_system(frame) for frame in frames]
    if options.meters_per_unit is None and not all(map(_in_metres, systems)):
        findings.warn(
            f"{source.name}: nothing says that its coordinate system ({systems[0][:40]!r}) is in "
            "metres; taken are metres. State --meters-per-unit. [capture.unit]"
        )
    return scan_of_shots(
        shots_of(lists, sensors, cameras[0], source),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=source.parent,
        meshes=("mesh.*", "*mesh*.obj", "*mesh*.ply", "*mesh*.glb"),
        how="Put a mesh in the frame of the calibrated cameras into this folder",
        # Of a frame of which nothing is stated nobody knows the scale either.
        up_axis="Z" if frames else None,
        in_metres=bool(frames),
    )


def _system(frame: object) -> str:
    """The definition of a scene reference frame's coordinate system, "" where none is stated."""
    system = frame.get("crs") if isinstance(frame, dict) else None
    return str(system.get("definition", "")) if isinstance(system, dict) else ""


def _in_metres(system: str) -> bool:
    """Whether a definition says so: in WKT; of codes of an authority only it knows the unit."""
    units = _UNIT.findall(system)
    return bool(units) and all(number_in({"": unit}, "") == 1 for unit in units)


def _resources(source: Path, kind: str, options: CaptureOptions) -> list[Any]:
    """The documents of a kind that the project names, in its order."""
    found = []
    for item in rows_of(read_json(source), "items"):
        for resource in rows_of(item, "resources"):
            if resource.get("format") == kind:
                place = _place_of(str(resource.get("uri", "")), source.parent)
                file = path_in_capture(source.parent, place, options)
                if not file.is_file():
                    raise InputRefused(
                        f"{source}: names {place!r}, which is not there. Bring the project's whole "
                        "folder. [capture.file]"
                    )
                found.append(read_json(file, unsigned=True))
    return found


def _place_of(uri: str, folder: Path) -> str:
    """What a URI names, relative to the project's folder where it lies there."""
    if not uri.lower().startswith("file:"):
        return unquote(uri)
    path = PurePosixPath(_path_and_page(uri)[0])
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


def _path_and_page(uri: str) -> tuple[str, str]:
    """Of a picture's URI; of a text that is none all of it is the path."""
    try:
        parts = urlsplit(uri)
    except ValueError:
        return unquote(uri), ""
    return unquote(parts.path), parts.fragment.removeprefix("page=")


def shots_of(lists: list[Any], sensors: list[Any], calibrated: object, source: Path) -> list[Shot]:
    """The photographs of a calibration."""
    uris = {
        str(row.get("id")): str(row.get("uri", ""))
        for each in lists
        for row in rows_of(each, "cameras")
    }
    sizes = {
        str(row.get("id")): numbers_among(row.get("image_size_px"), 2)
        for each in sensors
        for row in rows_of(each, "sensors")
    }
    cameras = {
        str(row.get("id")): _camera(row.get("internals"), sizes.get(str(row.get("id"))), source)
        for row in rows_of(calibrated, "sensors")
    }
    found = []
    for row in rows_of(calibrated, "cameras"):
        name, page = _path_and_page(uris.get(number := str(row.get("id")), ""))
        camera, turn = cameras.get(str(row.get("sensor_id")), (None, np.eye(3)))
        pose = _pose(row)
        if pose is not None:
            pose[:3, :3] = pose[:3, :3] @ turn.T
        later = f"it is page {page} of its file" if page not in ("", "0") else ""
        found.append(
            Shot(
                name=name or number,
                camera=camera,
                world_from_camera=pose,
                problem=later if name else "the list of pictures has none of its number",
            )
        )
    return found


def _pose(row: dict[str, Any]) -> Double | None:
    """(4, 4) world from camera, OpenCV's axes."""
    place = numbers_among(row.get("position"), 3)
    angles = numbers_among(row.get("orientation_deg"), 3)
    if place is None or angles is None:
        return None
    turn = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    return opengl_from_opencv(rigid_pose(turn, place))  # the same turn back


def _camera(stated: object, size: Double | None, source: Path) -> tuple[ShotCamera | None, Double]:
    """A sensor's, and how it is turned (3, 3) around its axis where that is of the lens."""
    said, straight = stated if isinstance(stated, dict) else {}, np.eye(3)
    centre = numbers_among(said.get("principal_point_px"), 2)
    if size is None or centre is None or not size.min() >= 1:
        return None, straight
    resolution, kind = (int(size[0]), int(size[1])), said.get("type")
    cx, cy = centre.tolist()
    if kind == "spherical":
        whole = Lens(curve="equirectangular")
        sphere = whole_sphere(*resolution)
        return ShotCamera(resolution=resolution, intrinsics=sphere, lens=whole), straight
    if kind == "fisheye":
        matrix, terms = numbers_among(said.get("affine"), 4), said.get("polynomial")
        count = len(terms) if isinstance(terms, list) else 0
        numbers = numbers_among(terms, count) if count > 1 else None
        if matrix is None or numbers is None or numbers[0]:
            return None, straight
        affine, rest = matrix.reshape(2, 2), tuple(numbers[1:].tolist())
        if not is_fisheye_of_turn(affine, rest):
            return None, straight
        lens, focals, turn = fisheye_of_turn(affine, rest)
        return ShotCamera(resolution=resolution, intrinsics=(*focals, cx, cy), lens=lens), turn
    if kind != "perspective":
        which = "no stated type" if kind is None else f"the type {str(kind)[:40]!r}"
        raise InputRefused(
            f"{source}: a sensor of {which} is not read (known: perspective, fisheye, spherical). "
            "Calibrate it as perspective or fisheye; or undistort the photographs elsewhere, and "
            "bring them with a transforms.json. [capture.camera]"
        )
    focal = numbers_among(said.get("focal_length_px"), 1)
    radial = numbers_among(said.get("radial_distortion"), 3)
    tangential = numbers_among(said.get("tangential_distortion"), 2)
    if focal is None or radial is None or tangential is None:
        return None, straight
    lens = Lens(radial=tuple(radial.tolist()), tangential=(tangential[0], tangential[1]))
    f = float(focal[0])
    return ShotCamera(resolution=resolution, intrinsics=(f, f, cx, cy), lens=lens), straight
