"""ScanNet: a scene whose .sens file has been unpacked into color/, pose/ and intrinsic/, with its
mesh and objects.

pose/N.txt is a matrix of four rows, world from camera, in OpenCV's axes, of infinities where the
camera was lost; it belongs to color/N.jpg. Pixel centres are whole numbers.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord, clause_of
from usdbrdf.capture.conventions import opengl_from_opencv
from usdbrdf.capture.formats.named_pictures import (
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_unused,
)
from usdbrdf.capture.formats.scannet_objects import annotated_objects
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.documents import read_text
from usdbrdf.files.images import image_size
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import number_in, number_rows
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "scannet"
DESCRIPTION = DESCRIPTIONS[NAME]
_LENSES = ("intrinsic/intrinsic_color.txt", "intrinsics_color.txt", "intrinsic_color.txt")
_MESH, _SEGMENTS, _GROUPS = "_vh_clean_2.ply", "_vh_clean_2.0.010000.segs.json", ".aggregation.json"
# Where no size is stated: a principal point this far from the middle belongs to another picture.
_OFF_CENTRE = 0.2
_UNPACK = (
    "Unpack the .sens file with ScanNet's reader.py (--export_color_images --export_poses "
    "--export_intrinsics)"
)


def matches(path: Path) -> bool:
    """A scene's folder with pose/ and color/, and a lens, a description or a mesh of ScanNet's."""
    if not ((path / "pose").is_dir() and (path / "color").is_dir()):
        return False
    named = any((path / name).is_file() for name in _LENSES)
    return named or _described(path) is not None or any(seen_of(path.glob(f"*{_MESH}")))


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    source = folder / "pose"
    if not source.is_dir():
        raise InputRefused(
            f"{folder}: no folder pose/. {_UNPACK} into this folder. [capture.format]"
        )
    camera = _camera(folder)
    pictures = pictures_of(folder, options, "color")
    refuse_without_pictures(pictures, source)
    records = []
    for file in sorted(seen_of(source.glob("*.txt")), key=lambda file: (len(file.name), file.name)):
        rows = number_rows(file)
        if [len(row) for row in rows] != [4] * 4:
            raise InputRefused(
                f"{file}: no pose of four rows with four numbers each. {_UNPACK} again. "
                "[capture.format]"
            )
        image, pose = pictures.named(file.stem), np.array(rows)
        if image is None:  # frames are often thinned out
            findings.count("poses_without_photograph", 1)
            continue
        if not np.isfinite(pose).all():
            findings.drop(image.name, "its camera was lost: its pose is infinite", "capture.pose")
            continue
        try:
            size = camera.resolution or image_size(image)[:2]
        except ImageRefused as error:
            findings.drop(image.name, clause_of(error, image), "capture.image")
            continue
        off = np.abs(np.array(camera.intrinsics[2:]) / size - 0.5).max()
        if camera.resolution is None and off > _OFF_CENTRE:
            said = "the lens in {} is for pictures of another size than its {} x {} pixels"
            findings.drop(image.name, said.format(_LENSES[0], *size), "capture.size")
            continue
        records.append(
            FrameRecord(
                name=image.name,
                image_path=image,
                world_from_camera=opengl_from_opencv(pose),
                intrinsics=camera.intrinsics,
                resolution=size,
                size_of_image=camera.resolution is None,
            )
        )
    if not records and findings.counts.get("poses_without_photograph"):
        raise InputRefused(
            f"{source}: none of its poses is called as a picture in {pictures.folder.name}, first "
            f"of which is {pictures.paths[0].name!r}. {_UNPACK} again. [capture.frames]"
        )
    warn_of_unused(pictures, (r.image_path for r in records), findings, source)
    how = f"Download the scene's *{_MESH}"
    mesh = partial(mesh_beside, folder, options, f"*{_MESH}", "*_vh_clean.ply", how=how)
    meshes = [options.mesh] if options.mesh is not None else seen_of(folder.glob(f"*{_MESH}"))
    segments = _objects_beside(meshes[0]) if meshes else ()
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        objects=annotated_objects(*segments) if segments else None,
    )


def _objects_beside(mesh: Path) -> tuple[Path, ...]:
    """The segments and groups of a mesh of ScanNet's; () of another."""
    scene = mesh.name.removesuffix(_MESH)
    if scene == mesh.name:
        return ()
    return mesh.with_name(f"{scene}{_SEGMENTS}"), mesh.with_name(f"{scene}{_GROUPS}")


def beside_mesh(mesh: Path) -> list[Path]:
    """The files that say the objects of a mesh of ScanNet's, as far as they are there."""
    return [file for file in _objects_beside(mesh) if file.is_file()]


class _Camera(NamedTuple):
    """With the centre of the first pixel at (0.5, 0.5); resolution None where nothing says it."""

    intrinsics: tuple[float, float, float, float]
    resolution: tuple[int, int] | None


def _camera(folder: Path) -> _Camera:
    """The lens of intrinsic_color.txt, else of the scene's description, which has the size."""
    described = _described(folder)
    said: dict[str, str | None] = {}
    for line in read_text(described).splitlines() if described else ():
        key, _, value = line.partition("=")
        said[key.strip()] = value.strip()
    size = [number_in(said, f"color{side}") or 0 for side in ("Width", "Height")]
    numbers = [number_in(said, f"{key}_color") for key in ("fx", "fy", "mx", "my")]
    file = next((folder / name for name in _LENSES if (folder / name).is_file()), None)
    if file is not None:
        rows = number_rows(file)
        if len(rows) < 3 or any(len(row) < 3 or not np.isfinite(row).all() for row in rows[:3]):
            raise InputRefused(f"{file}: no matrix of a camera. {_UNPACK} again. [capture.camera]")
        numbers = [float(rows[i][k]) for i, k in ((0, 0), (1, 1), (0, 2), (1, 2))]
    fx, fy, cx, cy = (number or 0.0 for number in numbers)
    if not min(fx, fy, cx, cy) > 0:
        raise InputRefused(
            f"{folder}: no lens in {_LENSES[0]}. {_UNPACK} into this folder. [capture.camera]"
        )
    whole = (int(size[0]), int(size[1])) if min(size) >= 1 else None
    return _Camera((fx, fy, cx + 0.5, cy + 0.5), whole)


def _described(folder: Path) -> Path | None:
    """scene0000_00.txt, whatever the folder is called."""
    named = (file for file in sorted(folder.glob("*.txt")) if re.match(r"scene\d+_\d+", file.stem))
    return next(named, None)
