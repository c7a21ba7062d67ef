"""Polycam's raw data: keyframes with ARKit's cameras, corrected ones where there are any, and the
mesh raw.glb.

A camera is t_ij, rows of a camera-to-world matrix in ARKit's axes (OpenGL's), y up, metres. The
mesh was turned and moved from there: alignmentTransform of mesh_info.json, column by column.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.reconstructions.shots import Shot, ShotCamera, scan_of_shots, size_in
from usdbrdf.capture.rigid_poses import is_camera_matrix
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import numbers_among
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "polycam"
DESCRIPTION = DESCRIPTIONS[NAME]
# Cameras and the pictures that go with them; corrected ones are without distortion and drift.
_KEYFRAMES = (
    ("keyframes/corrected_cameras", "keyframes/corrected_images"),
    ("keyframes/cameras", "keyframes/images"),
)
_ALIGNMENT = "alignmentTransform"


def matches(path: Path) -> bool:
    """A folder with keyframes/cameras or keyframes/corrected_cameras."""
    return any((path / cameras).is_dir() for cameras, _ in _KEYFRAMES)


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    # Some exports have the folders of corrected ones, with nothing in them.
    whole = [kind for kind in _KEYFRAMES if all(_holds_any(folder / name) for name in kind)]
    if not whole:
        raise InputRefused(
            f"{folder}: no keyframes/cameras with keyframes/images. Export 'Raw Data' from Polycam "
            "(developer mode), and name its folder. [capture.format]"
        )
    cameras, images = whole[0]
    if whole[0] is _KEYFRAMES[1]:
        findings.warn(
            f"{folder.name}: no corrected cameras, so poses drift as ARKit's do and the lens's "
            "distortion stays. Process the scan again with Loop Closure, or refine the poses "
            "(--refine-poses). [capture.pose]"
        )
    mesh_from_world = _alignment(folder / "mesh_info.json", findings)
    documents = seen_of((folder / cameras).glob("*.json"))
    return scan_of_shots(
        [_shot(document, mesh_from_world) for document in documents],
        options,
        findings,
        adapter=NAME,
        source=folder / cameras,
        folder=folder,
        pictures_in=(images,),
        meshes=("raw.glb", "mesh.*"),
        how="Export 'Raw Data' from Polycam with raw.glb, or the mesh as GLTF, into this folder",
        up_axis="Y",
        in_metres=True,
        # What the corrected ones show of no picture, black by up to some ten pixels.
        rim=whole[0] is _KEYFRAMES[0],
    )


def _holds_any(folder: Path) -> bool:
    return folder.is_dir() and any(seen_of(folder.iterdir()))


def _alignment(path: Path, findings: Findings) -> Double:
    """(4, 4) from the world of the cameras to that of the mesh; InputRefused unless it is rigid."""
    if not path.is_file():
        findings.warn(
            f"{path.name}: not there, so the mesh is taken to lie in the frame of the cameras. "
            "[capture.pose]"
        )
        return np.eye(4)
    document: Any = read_json(path)
    stated = document.get(_ALIGNMENT) if isinstance(document, dict) else None
    numbers = np.eye(4) if stated is None else numbers_among(stated, 16)
    matrix = None if numbers is None else numbers.reshape(4, 4).T
    sound = matrix is not None and is_camera_matrix(matrix)
    turn = matrix[:3, :3] if matrix is not None and sound else np.zeros((3, 3))
    if matrix is None or np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3:
        raise InputRefused(
            f"{path}: {_ALIGNMENT} is no rigid matrix of 16 numbers, so nobody knows where the "
            "mesh lies. Export the raw data again. [capture.pose]"
        )
    return matrix


def _shot(document: Path, mesh_from_world: Double) -> Shot:
    stated: Any = read_json(document)
    row = stated if isinstance(stated, dict) else {}
    size = size_in(row)
    numbers = numbers_among([row.get(key) for key in ("fx", "fy", "cx", "cy")], 4)
    entries = numbers_among([row.get(f"t_{i}{k}") for i in range(3) for k in range(4)], 12)
    camera = pose = None
    if numbers is not None and min(size):
        fx, fy, cx, cy = numbers.tolist()
        camera = ShotCamera(resolution=size, intrinsics=(fx, fy, cx, cy))
    if entries is not None:
        pose = mesh_from_world @ np.vstack([entries.reshape(3, 4), [0.0, 0, 0, 1]])
        pose = opengl_from_opencv(pose)  # the same turn back
    return Shot(name=document.stem, camera=camera, world_from_camera=pose)
