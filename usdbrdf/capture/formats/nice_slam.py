"""The renders of Replica that NICE-SLAM, iMAP and those after them use: traj.txt and results/.

traj.txt has one line per frame: 16 numbers, row by row, world from camera, in OpenCV's axes. The
size and the lens stand in cam_params.json beside or above; where it is missing they are what all
these renders have. Pixel centres are whole numbers there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    pictures_of,
    refuse_without_pictures,
    scan_of,
)
from usdbrdf.capture.formats.replica_semantics import semantic_files, semantics_beside
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.tables import number_rows
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "nice-slam"
DESCRIPTION = DESCRIPTIONS[NAME]
_KEYS = ("w", "h", "fx", "fy", "cx", "cy")
# Of the renders that were published, whose archive has cam_params.json outside the scenes.
_PUBLISHED = {"w": 1200, "h": 680, "fx": 600.0, "fy": 600.0, "cx": 599.5, "cy": 339.5}


def matches(path: Path) -> bool:
    """A folder with traj.txt and results/."""
    return (path / "traj.txt").is_file() and (path / "results").is_dir()


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    source = folder / "traj.txt"
    if not source.is_file():
        raise InputRefused(
            f"{folder}: no traj.txt. Name the scene's folder, which has it beside results/. "
            "[capture.format]"
        )
    poses = number_rows(source)
    if any(len(row) != 16 for row in poses):
        wrong = next(len(row) for row in poses if len(row) != 16)
        raise InputRefused(
            f"{source}: a line of {wrong} numbers where each pose has 16. Export it again. "
            "[capture.format]"
        )
    found = pictures_of(folder, options, "results")
    # Depth maps lie among the frames.
    named = (p for p in found.paths if not p.name.startswith(("depth", "semantic")))
    pictures = Pictures(folder=found.folder, paths=tuple(named))
    refuse_without_pictures(pictures, source)
    camera = _camera(folder, findings)
    numbered = pictures.numbered()
    # Frames count from 0; where one has the number of poses, from 1.
    last = max(numbered, default=0)
    first = int(last == len(poses) and 0 not in numbered)
    if last - first >= len(poses):
        raise InputRefused(
            f"{source}: {len(poses)} poses for pictures numbered up to {last}. Bring the "
            "trajectory of these pictures. [capture.frames]"
        )
    records = []
    for number, image in sorted(numbered.items()):
        pose = poses[number - first].reshape(4, 4)
        records.append(
            FrameRecord(
                name=image.name,
                image_path=image,
                world_from_camera=opengl_from_opencv(pose),
                intrinsics=(camera["fx"], camera["fy"], camera["cx"] + 0.5, camera["cy"] + 0.5),
                resolution=(int(camera["w"]), int(camera["h"])),
            )
        )
    findings.count("poses_without_photograph", len(poses) - len(records))
    mesh = _mesh(folder, options)
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        objects=semantics_beside(mesh),
    )


def beside(path: Path) -> list[Path]:
    """The files that this format keeps beside a scene's folder, as far as they are there."""
    folder = path.resolve()
    mesh = folder.parent / f"{folder.name}_mesh.ply"
    own = [file for file in (folder.parent / "cam_params.json", mesh) if file.is_file()]
    return own + (beside_mesh(mesh) if mesh in own else [])


def beside_mesh(mesh: Path) -> list[Path]:
    """The files that say the objects of a mesh of Replica, as far as they are there."""
    return semantic_files(mesh)


def _camera(folder: Path, findings: Findings) -> dict[str, float]:
    """Width, height and lens, with the centre of the first pixel at (0, 0)."""
    path = folder / "cam_params.json"
    if not path.is_file():
        path = folder.parent / path.name
    if not path.is_file():
        findings.warn(
            f"{folder.name}: no cam_params.json, so the camera is that of the published renders, "
            "1200 x 680 pixels with a focal length of 600. [capture.camera]"
        )
        return dict(_PUBLISHED)
    document: Any = read_json(path)
    camera = document.get("camera", document) if isinstance(document, dict) else None
    numbers: list[Any] = [camera.get(key) for key in _KEYS] if isinstance(camera, dict) else [None]
    if not all(isinstance(n, int | float) and not isinstance(n, bool) for n in numbers):
        raise InputRefused(
            f"{path}: no camera with the numbers {', '.join(_KEYS)}. Bring the file of the "
            "dataset. [capture.camera]"
        )
    return dict(zip(_KEYS, map(float, numbers), strict=True))


def _mesh(folder: Path, options: CaptureOptions) -> Path:
    outside = folder.parent / f"{folder.name}_mesh.ply"
    if options.mesh is None and not (folder / "mesh.ply").is_file() and outside.is_file():
        return outside
    how = f"Put {outside.name} of the dataset beside the folder"
    return mesh_beside(folder, options, "mesh.ply", how=how)
