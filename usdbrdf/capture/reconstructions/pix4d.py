"""Pix4Dmapper's NAME_calibrated_camera_parameters.txt of a project's folder 1_initial/params, the
photographs, and the project's mesh.

Ten lines a photograph: its name and size, a camera matrix, radial and tangential distortion, the
camera's centre, the rotation from the world to the camera (OpenCV's axes). The world is the
project's, from which NAME_offset.xyz was taken, as from its mesh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import (
    Shot,
    ShotCamera,
    capture_folder_of,
    files_of_capture,
    scan_of_shots,
)
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_text
from usdbrdf.files.tables import beginning_in_utf8, files_of, numbers_among, only_one
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens
from usdbrdf.options import CaptureOptions

NAME = "pix4d"
DESCRIPTION = DESCRIPTIONS[NAME]
_PLACE = "1_initial/params"
_MESHES = (
    "mesh.*", "2_densification/3d_mesh/*_simplified_3d_mesh.obj", "*_3d_mesh.obj",
    "2_densification/3d_mesh/*.obj",
)  # fmt: skip
# How the explanation at a file's head begins, and ends.
_HEAD, _LAST = b"fileName imageWidth imageHeight", "camera model m = K [R|-Rt] X"
# Numbers of a photograph's ten lines, of which the first begins with its name.
_COUNTS = (2, 3, 3, 3, 3, 2, 3, 3, 3, 3)


def matches(path: Path) -> bool:
    """Such a file, a folder with one, or a project's folder."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    files = files_of(path, [".txt"]) + files_of(path / _PLACE, [".txt"])
    return [file for file in files if beginning_in_utf8(file).lstrip().startswith(_HEAD)]


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    called = "files calibrated_camera_parameters.txt"
    source = only_one(documents, path, called, f"Name the one in {_PLACE} of the project")
    return scan_of_shots(
        shots_of(source),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=_home(path),
        meshes=_MESHES,
        how="Have the 3D textured mesh generated (OBJ), and name the project's folder",
    )


def beside(path: Path) -> list[Path]:
    """What the project holds above the folder of its parameters, where that is named."""
    home = _home(path)
    return [] if home == capture_folder_of(path) else files_of_capture(home, meshes=_MESHES)


def _home(path: Path) -> Path:
    """The capture's folder: the project's, where a place in it is named."""
    folder = capture_folder_of(path)
    place = Path(_PLACE).parts
    return folder.parents[len(place) - 1] if folder.parts[-len(place) :] == place else folder


def shots_of(source: Path) -> list[Shot]:
    """The photographs of a document."""
    lines = [line.strip() for line in read_text(source).splitlines() if line.strip()]
    begin = lines.index(_LAST) + 1 if _LAST in lines else len(lines)
    rows = lines[begin:]
    if not rows or len(rows) % len(_COUNTS):
        raise InputRefused(
            f"{source}: {len(rows)} lines below {_LAST!r}, where each photograph has "
            f"{len(_COUNTS)}. It was cut off, or its cameras are fisheyes, which are not read. "
            "[capture.format]"
        )
    return [_shot(rows[i : i + len(_COUNTS)]) for i in range(0, len(rows), len(_COUNTS))]


def _shot(lines: list[str]) -> Shot:
    name, *size = lines[0].rsplit(None, 2)
    words = [size, *(line.split() for line in lines[1:])]
    read = [numbers_among(row, count) for row, count in zip(words, _COUNTS, strict=True)]
    found = [row for row in read if row is not None]
    if len(found) < len(_COUNTS) or not min(found[0][0], found[0][1], found[1][0]) > 0:
        return Shot(
            name=name, camera=None, world_from_camera=None, problem="its lines hold no camera"
        )
    (width, height), matrix, radial, tangential = found[0], np.stack(found[1:4]), *found[4:6]
    return Shot(
        name=name,
        camera=ShotCamera(
            resolution=(int(width), int(height)),
            intrinsics=(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]),
            lens=Lens(radial=tuple(radial.tolist()), tangential=(tangential[0], tangential[1])),
        ),
        world_from_camera=rigid_pose(np.stack(found[7:]).T, found[6]),
    )
