"""Meshroom (AliceVision): cameras.sfm or sfm.json, the photographs, and the mesh of its node
Meshing, MeshFiltering or Texturing.

A pose is the camera's centre and the rotation from the world to it (OpenCV's axes), column by
column. Numbers are texts. Focal lengths are in mm of a sensor whose width is stated, older ones in
pixels; how the second follows from the first has changed with the document's version. So has the
frame of exported meshes: since 1.2.3 their y and z are those of the cameras, negated. Of a rig the
pose is the rig's, and each camera has its own within it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import (
    Shot,
    ShotCamera,
    files_of_capture,
    rows_of,
    scan_of_shots,
    size_in,
)
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import beginning_of, files_of, numbers_among
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens
from usdbrdf.options import CaptureOptions

NAME = "meshroom"
DESCRIPTION = DESCRIPTIONS[NAME]
Version = tuple[int, ...]
# Versions from which on documents are otherwise, up to the newest that is known.
_SINCE: dict[str, Version] = {
    "two focal lengths": (1, 2, 0),
    "principal points from the middle": (1, 2, 1),
    "focal lengths in mm": (1, 2, 2),
    "meshes in OpenGL's frame": (1, 2, 3),
    "pixelRatio multiplies": (1, 2, 5),
    "focalLength is the second": (1, 2, 11),
    "newest": (1, 2, 12),
}
# Where a project keeps what its nodes have made, those of them that turn or find cameras, and what
# those make that mesh, each before what it works on; beside a document that was taken from there,
# the same names.
_CACHE, _NODES = "MeshroomCache", ("SfMTransform", "StructureFromMotion")
_TEXTURED = (("Texturing", "texturedMesh.obj"), ("MeshFiltering", "mesh.obj"))
_BESIDE = ("texturedMesh.*", "mesh.*")
_OPENGL = np.diag([1.0, -1.0, -1.0])
_FULL_FRAME_MM = 36.0
# Before 1.2.8 the type of a camera said its distortion too.
_OLD_TYPES = {"radial1": "radialk1", "radial3": "radialk3", "fisheye4": "fisheye"}
# Numbers of each distortion.
_COUNTS = {"none": 0, "radialk1": 1, "radialk3": 3, "brown": 5, "fisheye": 4, "fisheye1": 1}


def matches(path: Path) -> bool:
    """Such a document, a folder with one or several of them, or a project's."""
    return bool(_documents(path) or _in_cache(path))


def _in_cache(path: Path) -> list[Path]:
    """What the last of the nodes that find cameras has left in a project's folder."""
    cache = path if path.name == _CACHE else path / _CACHE
    found = (seen_of(cache.glob(f"{node}/*/cameras.sfm")) for node in _NODES)
    return next(filter(None, found), [])


def _home(source: Path) -> Path:
    """The capture's folder: the project's where the document lies in its cache."""
    folder = source.parent
    above = folder.parents[1:3]  # of the node's result and of the node: the cache, the project
    return above[1] if folder.parent.name in _NODES and above[0].name == _CACHE else folder


def beside(path: Path) -> list[Path]:
    """What lies in a project's folder, where a place in its cache is named."""
    found = _documents(path.resolve()) or _in_cache(path.resolve())
    home = _home(found[0]) if found else path.resolve()
    if home == path.resolve() or not path.resolve().is_relative_to(home):
        return []
    return files_of_capture(home, meshes=_meshes(home))


def _meshes(home: Path) -> tuple[str, ...]:
    """Patterns of its own names; that in the cache of the last node that has made any, if one."""
    made = (f"{_CACHE}/{node}/*/{name}" for node, name in _TEXTURED)
    counts = ((pattern, len(list(home.glob(pattern)))) for pattern in made)
    last, count = next(((pattern, count) for pattern, count in counts if count), ("", 0))
    return (*_BESIDE, last) if count == 1 else _BESIDE


def _documents(path: Path) -> list[Path]:
    """Those with poses before others, of Meshroom's own names before others."""
    heads = ((file, beginning_of(file)) for file in files_of(path, [".sfm", ".json"]))
    words = (b'"featuresFolders"', b'"viewId"')
    found = [f for f, head in heads if f.suffix.lower() == ".sfm" or any(w in head for w in words)]
    return sorted(found, key=lambda file: (file.stem != "cameras", file.name))


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    cached = [] if documents else _in_cache(path.resolve())
    if len(cached) > 1:
        raise InputRefused(
            f"{path}: {len(cached)} results of the project have cameras, first "
            f"{cached[0]}. Name the cameras.sfm of the one that the mesh was made with. "
            "[capture.format]"
        )
    documents = documents or cached
    if not documents:
        raise InputRefused(
            f"{path}: no cameras.sfm. Name the file that the node StructureFromMotion writes. "
            "[capture.format]"
        )
    source = documents[0]
    document: Any = read_json(source)
    version = _version(document, source)
    if not rows_of(document, "poses"):
        raise InputRefused(
            f"{source}: no poses of cameras. Name cameras.sfm of the node StructureFromMotion; "
            "others hold the photographs before their alignment. [capture.alignment]"
        )
    if version > _SINCE["newest"]:
        said = ".".join(map(str, version))
        newest = ".".join(map(str, _SINCE["newest"]))
        findings.warn(
            f"{source.name}: version {said} is newer than what is known here; it is read as "
            f"{newest}. Look at the agreement that `usdbrdf inspect` states. [capture.format]"
        )
    return scan_of_shots(
        shots_of(document, version, source),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=_home(source),
        meshes=_meshes(_home(source)),
        how="Put texturedMesh.obj of the node Texturing (or mesh.obj of MeshFiltering) into this "
        "folder",
    )


def _version(document: object, source: Path) -> Version:
    stated = document.get("version") if isinstance(document, dict) else None
    numbers = numbers_among(stated, 3)
    if numbers is None:
        raise InputRefused(
            f"{source}: no version, so this is none of Meshroom's. Name cameras.sfm of the node "
            "StructureFromMotion. [capture.format]"
        )
    return tuple(int(number) for number in numbers)


def shots_of(document: object, version: Version, source: Path) -> list[Shot]:
    """The photographs of a document."""
    cameras = {
        str(row.get("intrinsicId")): _camera(row, version, source)
        for row in rows_of(document, "intrinsics")
    }
    turn = _OPENGL if version >= _SINCE["meshes in OpenGL's frame"] else np.eye(3)
    poses = {str(row.get("poseId")): _pose(row, turn) for row in rows_of(document, "poses")}
    rig_from_camera = {
        (str(row.get("rigId")), str(number)): _pose_in_rig(place)
        for row in rows_of(document, "rigs")
        for number, place in enumerate(rows_of(row, "subPoses"))
    }
    views = rows_of(document, "views")
    found = []
    for view in views:
        pose, problem = poses.get(str(view.get("poseId"))), ""
        # Of a rig one pose is that of all its cameras, unless each has its own. Where that is not
        # stated (brackets share a pose, too), it has a place in the rig if one was found.
        stated = view.get("isPoseIndependant")
        if "rigId" in view and str(stated).lower() not in ("true", "1") and pose is not None:
            place = rig_from_camera.get((str(view["rigId"]), str(view.get("subPoseId"))))
            if place is not None:
                pose = pose @ place
            elif stated is not None:
                problem = "nothing says where it stands in its rig"
        found.append(
            Shot(
                name=str(view.get("path") or view.get("viewId")),
                camera=cameras.get(str(view.get("intrinsicId"))),
                world_from_camera=pose,
                problem=problem,
            )
        )
    return found


def _pose_in_rig(place: dict[str, Any]) -> Double | None:
    """(4, 4) from a camera of a rig to it; None where that was never found."""
    if str(place.get("status", "")).lower() == "uninitialized":
        return None
    return _rigid(place.get("pose"), np.eye(3))


def _pose(row: dict[str, Any], turn: Double) -> Double | None:
    """(4, 4) world from camera, in the frame of the meshes."""
    holder = row.get("pose")
    return _rigid(holder.get("transform") if isinstance(holder, dict) else None, turn)


def _rigid(stated: object, turn: Double) -> Double | None:
    """(4, 4) of a rotation and a centre, turned; None where there are none."""
    if not isinstance(stated, dict):
        return None
    rotation, centre = (
        numbers_among(stated.get("rotation"), 9),
        numbers_among(stated.get("center"), 3),
    )
    if rotation is None or centre is None:
        return None
    # Column by column of what turns the world: row by row of what turns the camera.
    return rigid_pose(turn @ rotation.reshape(3, 3), turn @ centre)


def _camera(row: dict[str, Any], version: Version, source: Path) -> ShotCamera | None:
    size = size_in(row)
    focal, centre = _focal_lengths(row, version, size), numbers_among(row.get("principalPoint"), 2)
    if not min(size) or focal is None or centre is None:
        return None
    if version >= _SINCE["principal points from the middle"]:
        centre = centre + np.array(size) / 2
    return ShotCamera(
        resolution=size,
        intrinsics=(*focal, float(centre[0]), float(centre[1])),
        lens=_lens(row, source),
    )


def _focal_lengths(
    row: dict[str, Any], version: Version, size: tuple[int, int]
) -> tuple[float, float] | None:
    """Across and down, in pixels."""
    if version < _SINCE["focal lengths in mm"]:
        stated = numbers_among(
            row.get("pxFocalLength"), 2 if version >= _SINCE["two focal lengths"] else 1
        )
        return None if stated is None else (float(stated[0]), float(stated[-1]))
    said = [
        row.get("focalLength"),
        row.get("sensorWidth", _FULL_FRAME_MM),
        row.get("pixelRatio", 1),
    ]
    numbers = numbers_among(said, 3)
    if numbers is None or not numbers.min() > 0:
        return None
    in_mm, sensor, ratio = numbers.tolist()
    focal = in_mm * size[0] / sensor
    if version >= _SINCE["focalLength is the second"]:
        return focal / ratio, focal
    return focal, focal * ratio if version >= _SINCE["pixelRatio multiplies"] else focal / ratio


def _lens(row: dict[str, Any], source: Path) -> Lens:
    kind = str(row.get("type", "pinhole")).lower()
    bends = str(row.get("distortionType") or _OLD_TYPES.get(kind, kind)).lower()
    bends = "none" if bends == "pinhole" else bends
    squeezed = str(row.get("undistortionType") or "none").lower() != "none"
    known = kind not in ("equidistant", "equidistant_r3", "3deanamorphic4")
    if not known or bends not in _COUNTS or squeezed:
        said = row.get("undistortionType") if squeezed else bends if known else kind
        raise InputRefused(
            f"{source}: a camera of the type {str(said)[:40]!r} is not read (known: "
            f"{', '.join(_COUNTS)} of pinhole). Reconstruct with one of these (CameraInit, default "
            "camera model). [capture.camera]"
        )
    count = _COUNTS[bends]
    numbers = numbers_among(row.get("distortionParams", []), count)
    if numbers is None:
        # Nothing, or zeros, of what was never estimated.
        numbers = np.zeros(count)
    terms = tuple(numbers.tolist())
    if bends == "brown":
        return Lens(radial=terms[:3], tangential=terms[3:])
    if bends == "fisheye1":
        return Lens(curve="fov", shape=terms)
    return Lens(curve="fisheye" if bends == "fisheye" else "perspective", radial=terms)
