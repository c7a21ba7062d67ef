"""Scans of telephones and of depth sensors: a trajectory of poses, a pinhole, and pictures that are
counted or named as the poses are. Their depths are not read: a mesh of them lies beside.

Record3D      metadata: K column by column and poses as quaternion (x, y, z, w) and place, OpenGL's
              axes (marek-simonik/record3d, issues 27, 36, 64, 83)
Stray Scanner odometry.csv: place and quaternion, OpenCV's axes, in ARKit's world, y up
              (strayrobots/scanner, docs/format.md, OdometryEncoder.swift)
Open3D        trajectory.log: world from camera, row by row; JSON: camera from world, column by
              column; OpenCV's axes, whole numbers are pixel centres (FileLOG.cpp,
              IJsonConvertible.cpp)
Matterport3D  matterport_camera_poses: world from camera, OpenCV's axes; of undistorted pictures
              OpenGL's, principal points counted from below (data_organization.md)
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import SUFFIXES, Pictures, pictures_of
from usdbrdf.capture.mesh_frames import path_in_capture
from usdbrdf.capture.reconstructions.shots import (
    Shot,
    ShotCamera,
    UnsizedCamera,
    capture_folder_of,
    files_of_capture,
    rows_of,
    scan_of_shots,
    size_in,
)
from usdbrdf.capture.reconstructions.trajectories import (
    counted_pictures,
    pinhole_of,
    poses_of,
    shots_of_numbers,
)
from usdbrdf.capture.unrecognised import OF_MATTERPORT, OPEN3D_LOG, STRAY_TABLE, of_record3d
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.documents import read_json, read_text
from usdbrdf.files.images import image_size
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import (
    beginning_in_utf8,
    csv_rows,
    files_of,
    number_in,
    number_rows,
    numbers_among,
    only_one,
)
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.usd_paths import USD_SUFFIXES

NAME = "rgbd-scan"
DESCRIPTION = DESCRIPTIONS[NAME]
_RECORD3D = ("metadata", "metadata.json")  # of an unzipped .r3d; of an export of pictures
_OF_TELEPHONES = ("rgbd", "rgb", "frames", "images", "color")
_VIDEO, _TABLE = "rgb.mp4", "odometry.csv"
_POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
_LENS = ("fx", "fy", "cx", "cy")
# What Open3D takes where nobody says a lens, of PrimeSense's cameras (PinholeCameraIntrinsic.cpp).
_PUBLISHED = (640, 480), (525.0, 525.0, 319.5, 239.5)
_TRAJECTORY, _OBJECTS = "trajectory", "objects.json"
_SCREEN = "ScreenCamera", "ScreenCapture"  # what its viewer calls a camera, and its picture
_MATTERPORT = "matterport_camera_poses", "matterport_camera_intrinsics"
_COLOUR_OF_HOUSE, _UNDISTORTED = "matterport_color_images", "undistorted_color_images"
_COLOUR = ("color", "rgb", "image", "images", "")  # Open3D's
# Where documents may lie in a capture, and the lens of a log.
_DOCUMENTS = ("scene", "undistorted_camera_parameters")
_LOGS = ("*.log", "*.txt")
_LENS_FILES = ("*.json", "*/*intrinsic*.json")
_OF_SCENES = ("mesh.*", "scene/integrated.ply")
_OF_HOUSES = ("mesh.*", "matterport_mesh/*/*.obj", "poisson_meshes/*.ply")
_FUSE = "Fuse its depths into a mesh in the frame of the poses ({}), and put mesh.ply beside them"
_DOWNLOAD = "Download matterport_mesh or poisson_meshes of the house, unzipped, into this folder"
_TSDF = "Open3D's ScalableTSDFVolume does"


class _Format(NamedTuple):
    """A program's way to write such scans.

    documents   those of a folder, or what a file is if it is one
    pictures    folders of them, the first that holds any
    shots       of the documents, the capture's folder and its pictures
    meshes      patterns of its own names; and what to do where there is none
    up_axis     None where the program does not say
    """

    documents: Callable[[Path], list[Path]]
    pictures: tuple[str, ...]
    shots: Callable[[Sequence[Path], Path, Pictures, Findings], Iterable[Shot]]
    meshes: tuple[str, ...]
    how: str
    up_axis: str | None = None


def matches(path: Path) -> bool:
    """A folder with a document of one of these programs, or such a document."""
    return _format_of(path) is not None


def _format_of(path: Path) -> _Format | None:
    return next((one for one in _FORMATS if one.documents(path)), None)


def read(path: Path, options: CaptureOptions) -> Scan:
    path, findings = path.resolve(), Findings()
    found = _format_of(path)
    if found is None:
        raise InputRefused(
            f"{path}: no metadata of Record3D with rgbd/, {_TABLE} of Stray Scanner, trajectory of "
            f"Open3D or {_MATTERPORT[0]} of Matterport3D. Name the folder that holds one. "
            "[capture.format]"
        )
    documents, folder = found.documents(path), _home(path)
    if options.objects is None and (folder / _OBJECTS).is_file():
        options = replace(options, objects=path_in_capture(folder, _OBJECTS, options))
    pictures = pictures_of(folder, options, *found.pictures)
    if not pictures.paths and (folder / _VIDEO).is_file():
        raise InputRefused(
            f"{folder / _VIDEO}: the pictures are in this video still. Extract all, counted from "
            f"0 as the poses are, into the folder rgb: ffmpeg -i {_VIDEO} -fps_mode passthrough "
            "-start_number 0 -q:v 1 rgb/%06d.jpg; then delete those that are not needed. "
            "[capture.frames]"
        )
    return scan_of_shots(
        found.shots(documents, folder, pictures, findings),
        options,
        findings,
        adapter=NAME,
        source=documents[0] if len(documents) == 1 else documents[0].parent,
        folder=folder,
        pictures_in=found.pictures,
        meshes=found.meshes,
        how=found.how,
        up_axis=found.up_axis,
        in_metres=True,
    )


def beside(path: Path) -> list[Path]:
    """What lies above the folder of a document, where that is named."""
    home = _home(path)
    if home == capture_folder_of(path):
        return []
    files = files_of_capture(home, meshes=_OF_SCENES + _OF_HOUSES)
    pictures = (
        file for name in (_COLOUR_OF_HOUSE, _UNDISTORTED) for file in (home / name).glob("*")
    )
    return [*files, *pictures, *_named_or_in(home, *_LENS_FILES, _OBJECTS)]


def _home(path: Path) -> Path:
    """The capture's folder: that above the one of a document, which has the pictures."""
    folder = capture_folder_of(path)
    own, above = (
        any((home / name).is_dir() for name in (*_COLOUR[:-1], _COLOUR_OF_HOUSE, _UNDISTORTED))
        for home in (folder, folder.parent)
    )
    return folder.parent if folder.name in _DOCUMENTS and above and not own else folder


def _named_or_in(path: Path, *patterns: str) -> list[Path]:
    """The file that a path is, if it is called so, or the folder's files that are."""
    if path.is_file():
        return [path] if any(path.match(pattern) for pattern in patterns) else []
    found = (file for pattern in patterns for file in seen_of(path.glob(pattern)))
    return [file for file in dict.fromkeys(found) if file.is_file()]


def _metadata(path: Path) -> list[Path]:
    """Record3D's: others call files so too."""
    found = _named_or_in(path, *_RECORD3D)
    return [
        file
        for file in found
        if any((file.parent / name).is_dir() for name in _OF_TELEPHONES[:2]) and of_record3d(file)
    ][:1]


def _of_record3d(
    documents: Sequence[Path], _: Path, pictures: Pictures, findings: Findings
) -> list[Shot]:
    source = documents[0]
    document = _object(read_json(source))
    poses, per_frame = document.get("poses"), document.get("perFrameIntrinsicCoeffs")
    if not isinstance(poses, list) or not poses:
        raise InputRefused(
            f"{source}: no list of poses, as of what was recorded without LiDAR. Record with the "
            "LiDAR camera, and export again. [capture.format]"
        )
    found = poses_of(numbers_among(pose, 7) for pose in poses)
    # Of the first frame; the lens moves, so newer versions say it of each.
    lenses = [pinhole_of(document.get("K"))]
    if isinstance(per_frame, list) and len(per_frame) == len(poses):
        each = (numbers_among(lens, 4) for lens in per_frame)
        lenses = [None if lens is None else (*lens.tolist(),) for lens in each]
    size = size_in(document, "w", "h")
    cameras = [
        None
        if lens is None
        else ShotCamera(resolution=size, intrinsics=lens)
        if min(size)
        else UnsizedCamera(intrinsics=lens)
        for lens in lenses
    ]
    opencv = [None if pose is None else opengl_from_opencv(pose) for pose in found]
    return shots_of_numbers(pictures.numbered().items(), opencv, cameras, pictures)


def _table(path: Path) -> list[Path]:
    found = _named_or_in(path, _TABLE)
    return [file for file in found if re.match(STRAY_TABLE, beginning_in_utf8(file))]


def _of_stray_scanner(
    documents: Sequence[Path], folder: Path, pictures: Pictures, findings: Findings
) -> list[Shot]:
    source = documents[0]
    rows, frames = _by_frame(csv_rows(source, _POSE))
    # Newer versions say the lens of each frame; the matrix is that of the last.
    found = [numbers_among([row.get(key) for key in _LENS], 4) for row in rows]
    lenses = [None if lens is None else (*lens.tolist(),) for lens in found]
    if not any(lenses):
        place = folder / "camera_matrix.csv"
        numbers = number_rows(place) if place.is_file() else ()
        if (lens := pinhole_of([row.tolist() for row in numbers])) is None:
            raise InputRefused(
                f"{place}: no matrix of 3 x 3 numbers, and {source.name} has no fx, fy, cx, cy. "
                "Copy the whole folder from the telephone again. [capture.camera]"
            )
        lenses = [lens]
    poses = poses_of(numbers_among([row.get(key) for key in _POSE], 7) for row in rows)
    cameras = [None if lens is None else UnsizedCamera(intrinsics=lens) for lens in lenses]
    counted = counted_pictures(pictures, frames, source, findings)
    return shots_of_numbers(counted, poses, cameras, pictures)


def _by_frame(
    rows: Sequence[Mapping[str, str]],
) -> tuple[Sequence[Mapping[str, str]], Sequence[int]]:
    """The rows in the order of their frames, with these; counted where they are no such numbers."""
    stated = [number_in(row, "frame") for row in rows]
    whole = [int(number) for number in stated if number is not None and number >= 0]
    if len(set(whole)) < len(rows) or whole != stated:
        return rows, range(len(rows))
    order = sorted(range(len(rows)), key=whole.__getitem__)
    return [rows[i] for i in order], [whole[i] for i in order]


def _of_open3d(path: Path) -> list[Path]:
    """A trajectory, one called so before others, JSON before a log, which has no lens; else the
    files of single cameras that have their pictures. Not where a USD stage may have the cameras:
    one that is not called as a mesh."""
    stages = files_of(path, USD_SUFFIXES) if path.is_dir() else []
    if len(stages) == 1 and stages[0].stem.lower() != "mesh":
        return []
    found = _named_or_in(path, "*.json", *_LOGS, *(f"scene/{log}" for log in _LOGS), "scene/*.json")
    heads = {file: beginning_in_utf8(file) for file in found}
    whole = [f for f in found if b'"PinholeCameraTrajectory"' in heads[f]] or [
        f for f in found if f.suffix != ".json" and re.match(OPEN3D_LOG, heads[f])
    ]
    named = [file for file in whole if file.stem == _TRAJECTORY]
    single = (f for f in found if b'"PinholeCameraParameters"' in heads[f])
    return named[:1] or whole or [file for file in single if _has_picture(file)]


def _has_picture(document: Path) -> bool:
    """Whether a picture is called as a single camera is, beside it or in a folder of pictures."""
    name = document.stem.replace(*_SCREEN)
    places = (document.parent / folder for folder in _COLOUR)
    return any(
        os.path.isfile(place / f"{name}{as_written(suffix)}")
        for place in places
        for suffix in SUFFIXES
        for as_written in (str.lower, str.upper)
    )


def _of_trajectory(
    documents: Sequence[Path], folder: Path, pictures: Pictures, findings: Findings
) -> list[Shot]:
    is_log = documents[0].suffix != ".json"
    read = [] if is_log else [_object(read_json(file)) for file in documents]
    if not is_log and not any("parameters" in document for document in read):
        return [
            Shot(
                name=file.stem.replace(*_SCREEN),
                camera=_stated(row),
                world_from_camera=_from_world(row),
            )
            for file, row in zip(documents, read, strict=True)
        ]
    how = "Name the one of the whole capture"
    source = only_one(documents, folder, "trajectories of Open3D", how)
    cameras: list[ShotCamera | None]
    if is_log:
        poses, cameras = _of_log(source), [_lens_beside(source, folder, pictures, findings)]
    else:
        rows = rows_of(read[0], "parameters")
        poses, cameras = [_from_world(row) for row in rows], [_stated(row) for row in rows]
    counted = counted_pictures(pictures, range(len(poses)), source, findings)
    return shots_of_numbers(counted, poses, cameras, pictures)


def _object(document: Any) -> dict[str, Any]:
    return document if isinstance(document, dict) else {}


def _of_log(source: Path) -> list[Double | None]:
    """Poses by the rows of each: three whole numbers, and a matrix of four rows."""
    rows = number_rows(source)
    if [len(row) for row in rows] != [3, 4, 4, 4, 4] * (len(rows) // 5):
        raise InputRefused(
            f"{source}: not five rows for each camera, three numbers and a matrix of four rows. It "
            "was cut off; write it again. [capture.format]"
        )
    return [np.stack(rows[i + 1 : i + 5]) for i in range(0, len(rows), 5)]


def _from_world(row: Mapping[str, Any]) -> Double | None:
    numbers = numbers_among(row.get("extrinsic"), 16)
    matrix = None if numbers is None else numbers.reshape(4, 4).T
    sound = matrix is not None and abs(np.linalg.det(matrix)) > 0.5
    return np.asarray(np.linalg.inv(matrix), np.float64) if matrix is not None and sound else None


def _stated(row: Mapping[str, Any]) -> ShotCamera | None:
    """Of a lens that Open3D writes, whole numbers are pixel centres."""
    inner = _object(row.get("intrinsic", row))
    lens = pinhole_of(inner.get("intrinsic_matrix"), 0.5)
    return None if lens is None else ShotCamera(resolution=size_in(inner), intrinsics=lens)


def _lens_beside(
    source: Path, folder: Path, pictures: Pictures, findings: Findings
) -> ShotCamera | None:
    """The lens of a log, in a JSON beside it, one that is called so before others; InputRefused
    where there is none, or several."""
    places = (*_named_or_in(folder, *_LENS_FILES), *source.parent.glob("*.json"))
    found: dict[ShotCamera, Path] = {}
    for file in sorted(places, key=lambda file: "intrinsic" not in file.name.lower()):
        if found and "intrinsic" not in file.name.lower():
            break
        head = beginning_in_utf8(file)
        is_lens = b'"intrinsic_matrix"' in head and b'"PinholeCameraParameters"' not in head
        if is_lens and (lens := _stated(_object(read_json(file)))):
            found.setdefault(lens, file)
    if len(found) > 1:
        one, other = [file.name for file in found.values()][:2]
        raise InputRefused(
            f"{source}: {one} and {other} state different lenses of it. Leave that of the pictures "
            "in color alone. [capture.camera]"
        )
    if found:
        return next(iter(found))
    (width, height), (fx, fy, cx, cy) = _PUBLISHED
    if not all(_is_of_size(picture, width, height) for picture in pictures.paths):
        raise InputRefused(
            f"{source}: no JSON beside it states the lens of the pictures. Write intrinsic.json: "
            '{"width": W, "height": H, "intrinsic_matrix": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}, in '
            "pixels. [capture.camera]"
        )
    findings.warn(
        f"{source.name}: no intrinsic.json beside it says a lens, so it is the one that Open3D "
        f"takes then, a focal length of {fx:g} for {width} x {height} pixels. Bring the file if "
        "the camera was another. [capture.camera]"
    )
    return ShotCamera(resolution=(width, height), intrinsics=(fx, fy, cx + 0.5, cy + 0.5))


def _is_of_size(picture: Path, width: int, height: int) -> bool:
    try:
        return image_size(picture)[:2] == (width, height)
    except ImageRefused:  # of which the frames tell
        return True


def _of_matterport(path: Path) -> list[Path]:
    """The poses, unless undistorted pictures alone are there."""
    poses = _named_or_in(path, f"{_MATTERPORT[0]}/*_pose_*.txt")
    whole = (path / _COLOUR_OF_HOUSE).is_dir() or not (path / _UNDISTORTED).is_dir()
    return poses if whole else []


def _of_house(
    documents: Sequence[Path], folder: Path, pictures: Pictures, findings: Findings
) -> list[Shot]:
    lenses: dict[str, ShotCamera | None] = {}
    shots = []
    for file in documents:
        rows = number_rows(file)
        panorama, _, rest = file.stem.rpartition("_pose_")
        camera, _, yaw = rest.partition("_")
        name = f"{panorama}_intrinsics_{camera}.txt"
        if name not in lenses:
            lenses[name] = _lens_of_matterport(folder / _MATTERPORT[1] / name)
        whole = [len(row) for row in rows] == [4] * 4
        shots.append(
            Shot(
                name=f"{panorama}_i{camera}_{yaw}.jpg",
                camera=lenses[name],
                world_from_camera=np.stack(rows) if whole else None,
            )
        )
    return shots


def _lens_of_matterport(file: Path) -> ShotCamera | None:
    rows = number_rows(file) if file.is_file() else ()
    numbers = np.concatenate(rows) if rows else np.zeros(0)
    if len(numbers) != 11 or not np.isfinite(numbers).all():
        return None
    width, height, fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers.tolist()
    return ShotCamera(
        resolution=(int(width), int(height)),
        intrinsics=(fx, fy, cx + 0.5, cy + 0.5),
        lens=Lens(radial=(k1, k2, k3), tangential=(p1, p2)),
    )


def _configuration(path: Path) -> list[Path]:
    found = _named_or_in(path, f"{_DOCUMENTS[1]}/*.conf", "*.conf")
    return [file for file in found if re.search(OF_MATTERPORT, beginning_in_utf8(file))][:1]


def _of_configuration(
    documents: Sequence[Path], folder: Path, pictures: Pictures, findings: Findings
) -> list[Shot]:
    """Lines "scan DEPTH PICTURE" and a matrix, each of the lens that was stated last."""
    camera, shots = None, []
    for line in read_text(documents[0]).splitlines():
        command, *words = line.split() or [""]
        if command == "intrinsics_matrix":
            lens = pinhole_of(words, 0.5)
            camera = None if lens is None else UnsizedCamera(intrinsics=lens, from_bottom=True)
        elif command == "scan" and len(words) > 2:
            numbers = numbers_among(words[2:], 16)
            pose = None if numbers is None else opengl_from_opencv(numbers.reshape(4, 4))
            shots.append(Shot(name=words[1], camera=camera, world_from_camera=pose))
    return shots


_FORMATS = (
    _Format(
        _metadata, _OF_TELEPHONES, _of_record3d, ("mesh.*",), _FUSE.format(_TSDF),
    ),
    _Format(
        _table, (*_OF_TELEPHONES, ""), _of_stray_scanner, ("mesh.*",),
        _FUSE.format("kekeblom/StrayVisualizer: stray_visualize.py --integrate --mesh-filename"),
        "Y",
    ),
    _Format(
        _of_open3d, _COLOUR, _of_trajectory, _OF_SCENES,
        "Integrate its depths into a mesh (run_system.py --integrate makes scene/integrated.ply)",
    ),
    _Format(_of_matterport, (_COLOUR_OF_HOUSE,), _of_house, _OF_HOUSES, _DOWNLOAD, "Z"),
    _Format(_configuration, (_UNDISTORTED,), _of_configuration, _OF_HOUSES, _DOWNLOAD, "Z"),
)  # fmt: skip
