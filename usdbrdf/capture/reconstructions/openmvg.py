"""OpenMVG's sfm_data.json: photographs, cameras and poses; a mesh beside, which another program has
made in their frame (OpenMVS).

A pose is the rotation from the world to the camera (OpenCV's axes) and the camera's centre.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import Shot, ShotCamera, rows_of, scan_of_shots, size_in
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.tables import beginning_of, files_of, numbers_among
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens, whole_sphere
from usdbrdf.options import CaptureOptions

NAME = "openmvg"
DESCRIPTION = DESCRIPTIONS[NAME]
# How many numbers each distortion has, by its name in the document.
_COUNTS = {"disto_k1": 1, "disto_k3": 3, "disto_t2": 5, "fisheye": 4}


def matches(path: Path) -> bool:
    """Such a document, or a folder with one or several of them."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    found = [f for f in files_of(path, [".json"]) if b'"sfm_data_version"' in beginning_of(f)]
    return sorted(found, key=lambda file: (file.name != "sfm_data.json", file.name))


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    if not documents:
        raise InputRefused(
            f"{path}: no sfm_data.json. Make one of a .bin with openMVG_main_ConvertSfM_DataFormat "
            "and name it. [capture.format]"
        )
    source = documents[0]
    document: Any = read_json(source)
    if not rows_of(document, "extrinsics"):
        raise InputRefused(
            f"{source}: no poses of cameras (extrinsics). Make it of the sfm_data.bin of the "
            "reconstruction with openMVG_main_ConvertSfM_DataFormat. [capture.alignment]"
        )
    return scan_of_shots(
        shots_of(document, source),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=source.parent,
        meshes=("mesh.*", "scene_*mesh*_texture.*", "scene_*mesh*.ply"),
        how="OpenMVG has poses and no surface: make a mesh in the same frame, for instance with "
        "OpenMVS, and put it into this folder",
    )


def shots_of(document: object, source: Path) -> list[Shot]:
    """The photographs of a document."""
    cameras = {
        str(row.get("key")): _camera(_data(row), source) for row in rows_of(document, "intrinsics")
    }
    poses = {
        str(row.get("key")): _pose(row.get("value")) for row in rows_of(document, "extrinsics")
    }
    found = []
    for view in map(_data, rows_of(document, "views")):
        name = PurePosixPath(str(view.get("local_path", "")), str(view.get("filename", "")))
        found.append(
            Shot(
                name=name.as_posix(),
                camera=cameras.get(str(view.get("id_intrinsic"))),
                world_from_camera=poses.get(str(view.get("id_pose"))),
            )
        )
    return found


def _data(row: dict[str, Any]) -> dict[str, Any]:
    """What the pointer in a row leads to; of a class whose base was written apart, both."""
    held: Any = row.get("value")
    for key in ("ptr_wrapper", "data"):
        held = held.get(key) if isinstance(held, dict) else None
    data: dict[str, Any] = held if isinstance(held, dict) else {}
    base = data.get("value0")
    return {**base, **data} if isinstance(base, dict) else data


def _pose(value: object) -> Double | None:
    """(4, 4) world from camera."""
    stated = value if isinstance(value, dict) else {}
    rotation, centre = (
        numbers_among(stated.get("rotation"), 9),
        numbers_among(stated.get("center"), 3),
    )
    if rotation is None or centre is None:
        return None
    return rigid_pose(rotation.reshape(3, 3).T, centre)


def _camera(data: dict[str, Any], source: Path) -> ShotCamera | None:
    size = size_in(data)
    if not min(size):
        return None
    if "focal_length" not in data:
        whole = Lens(curve="equirectangular")
        return ShotCamera(resolution=size, intrinsics=whole_sphere(*size), lens=whole)
    focal, centre = (
        numbers_among(data["focal_length"], 1),
        numbers_among(data.get("principal_point"), 2),
    )
    if focal is None or centre is None:
        return None
    return ShotCamera(
        resolution=size,
        intrinsics=(float(focal[0]), float(focal[0]), float(centre[0]), float(centre[1])),
        lens=_lens(data, source),
    )


def _lens(data: dict[str, Any], source: Path) -> Lens:
    named = next((name for name in _COUNTS if name in data), None)
    if unknown := [name for name in data if name.startswith("disto") and name not in _COUNTS]:
        raise InputRefused(
            f"{source}: {unknown[0][:40]} of a camera is a distortion that is not known (known: "
            f"{', '.join(_COUNTS)}). Undistort the pictures with OpenMVG, and name the document of "
            "these. [capture.camera]"
        )
    if named is None:
        return Lens()
    numbers = numbers_among(data[named], _COUNTS[named])
    if numbers is None:
        raise InputRefused(
            f"{source}: {named} of a camera is not {_COUNTS[named]} finite numbers. Write it again "
            "with OpenMVG. [capture.camera]"
        )
    terms = tuple(numbers.tolist())
    if named == "disto_t2":
        return Lens(radial=terms[:3], tangential=terms[3:])
    return Lens(curve="fisheye" if named == "fisheye" else "perspective", radial=terms)
