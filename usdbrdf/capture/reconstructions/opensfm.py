"""OpenSfM's reconstruction.json, of OpenDroneMap too: photographs, cameras, poses; a mesh beside.

A pose is the rotation (axis times angle) and the translation from the world to the camera, OpenCV's
axes. Focal lengths and principal points are parts of the longer side, these from the middle.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import (
    Shot,
    ShotCamera,
    capture_folder_of,
    files_of_capture,
    scan_of_shots,
    size_in,
)
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.tables import numbers_among
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens, whole_sphere
from usdbrdf.options import CaptureOptions

NAME = "opensfm"
DESCRIPTION = DESCRIPTIONS[NAME]
# Where it lies in a project of OpenSfM, and in one of OpenDroneMap; with a mesh of each photograph.
_PLACES = ("reconstruction.json", "opensfm/reconstruction.json", "reconstruction.meshed.json")
_MESHES = ("mesh.*", "odm_texturing/odm_textured_model.obj", "odm_meshing/odm_mesh.ply")
_SPHERES = ("spherical", "equirectangular")
# Radial terms of each projection. Tangential and prism terms are 0 where it has none.
_COUNTS = {
    "perspective": 2, "simple_radial": 1, "radial": 2, "brown": 3,
    "fisheye": 2, "fisheye_opencv": 4, "fisheye62": 6, "fisheye624": 6,
}  # fmt: skip


def matches(path: Path) -> bool:
    """A project's folder, or the document itself."""
    return _document(path) is not None


def _document(path: Path) -> Path | None:
    if path.is_file():
        return path if path.name in ("reconstruction.json", "reconstruction.meshed.json") else None
    return next((path / place for place in _PLACES if (path / place).is_file()), None)


def read(path: Path, options: CaptureOptions) -> Scan:
    source, findings = _document(path.resolve()), Findings()
    if source is None:
        raise InputRefused(f"{path}: no {_PLACES[0]}. Name its folder. [capture.format]")
    folder = _home(source)
    document: Any = read_json(source)
    parts = [p for p in document if _listed(p)] if isinstance(document, list) else []
    if not parts:
        raise InputRefused(
            f"{source}: no list of reconstructions with shots. Name the file that 'opensfm "
            "reconstruct' writes. [capture.format]"
        )
    largest = max(parts, key=lambda part: len(_listed(part)))
    if len(parts) > 1:
        findings.warn(
            f"{source.name}: {len(parts)} reconstructions that do not go together; taken is the "
            f"one with most photographs, {len(_listed(largest))}. [capture.format]"
        )
    return scan_of_shots(
        shots_of(largest, source),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        meshes=_MESHES,
        how="Put a mesh in the frame of the reconstruction, which georeferenced ones do not have, "
        "into this folder",
        in_metres=_knows_its_place(largest),
    )


def beside(path: Path) -> list[Path]:
    """What OpenDroneMap's folder holds above the one of the document, where that is named."""
    source = _document(path.resolve())
    home = capture_folder_of(path) if source is None else _home(source)
    return [] if home == capture_folder_of(path) else files_of_capture(home, meshes=_MESHES)


def _home(source: Path) -> Path:
    """The capture's folder: OpenDroneMap's, which has the pictures beside opensfm/, or its own,
    whatever that is called."""
    above = source.parent.parent
    of_drone_map = source.parent.name == "opensfm" and (
        (above / "images").is_dir() or any(above.glob("odm_*"))
    )
    own = (source.parent / "images").is_dir()
    return above if of_drone_map and not own else source.parent


def _knows_its_place(part: dict[str, Any]) -> bool:
    """Whether photographs said where on Earth they were taken, which gives a scale too."""
    stated = part.get("reference_lla")
    row = stated if isinstance(stated, dict) else {}
    place = numbers_among([row.get("latitude"), row.get("longitude")], 2)
    return place is not None and bool(place.any())


def _listed(part: object) -> dict[str, Any]:
    shots = part.get("shots") if isinstance(part, dict) else None
    return shots if isinstance(shots, dict) else {}


def shots_of(part: dict[str, Any], source: Path) -> list[Shot]:
    """The photographs of one reconstruction."""
    stated = part.get("cameras")
    named = stated if isinstance(stated, dict) else {}
    cameras = {k: _camera(v, source) for k, v in named.items() if isinstance(v, dict)}
    return [
        Shot(name=name, camera=cameras.get(str(shot.get("camera"))), world_from_camera=_pose(shot))
        for name, shot in _listed(part).items()
        if isinstance(shot, dict)
    ]


def _pose(shot: dict[str, Any]) -> Double | None:
    """(4, 4) world from camera."""
    turn, shift = numbers_among(shot.get("rotation"), 3), numbers_among(shot.get("translation"), 3)
    if turn is None or shift is None:
        return None
    world_from_camera = Rotation.from_rotvec(turn).as_matrix().T
    return rigid_pose(world_from_camera, -world_from_camera @ shift)


def _camera(row: dict[str, Any], source: Path) -> ShotCamera | None:
    size, kind = size_in(row), str(row.get("projection_type", "perspective"))
    if not min(size):
        return None
    if kind in _SPHERES:
        whole = Lens(curve="equirectangular")
        return ShotCamera(resolution=size, intrinsics=whole_sphere(*size), lens=whole)
    if kind not in _COUNTS:
        raise InputRefused(
            f"{source}: a camera of the type {kind[:40]!r} is not read (known: "
            f"{', '.join((*_COUNTS, *_SPHERES))}). Undistort the photographs ('opensfm "
            "undistort'), and name undistorted/reconstruction.json. [capture.camera]"
        )
    one = row.get("focal")
    said = [row.get("focal_x", one), row.get("focal_y", one), row.get("c_x", 0), row.get("c_y", 0)]
    parts = numbers_among(said, 4)
    names = [*(f"k{i + 1}" for i in range(_COUNTS[kind])), "p1", "p2", "s0", "s1", "s2", "s3"]
    terms = numbers_among([row.get(name, 0) for name in names], len(names))
    if parts is None or terms is None or not parts[:2].min() > 0:
        return None
    fx, fy, cx, cy = (parts * max(size) + (0, 0, size[0] / 2, size[1] / 2)).tolist()
    p1, p2, s1, s2, s3, s4 = terms[-6:].tolist()
    return ShotCamera(
        resolution=size,
        intrinsics=(fx, fy, cx, cy),
        lens=Lens(
            curve="fisheye" if kind.startswith("fisheye") else "perspective",
            radial=tuple(terms[:-6].tolist()),
            tangential=(p1, p2),
            prism=(s1, s2, s3, s4),
        ),
    )
