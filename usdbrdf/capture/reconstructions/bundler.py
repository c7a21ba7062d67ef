"""Bundler's .out files, which COLMAP, Metashape, RealityScan and others write too: cameras in the
order of a list of pictures beside; a mesh in their frame.

A camera is a focal length in pixels with k1 and k2, from the middle of a picture of which nothing
is said, and what leads from the world to it, in OpenGL's axes.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.reconstructions.shots import (
    CentredCamera,
    Shot,
    capture_folder_of,
    files_of_capture,
    scan_of_shots,
)
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_text
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import beginning_in_utf8, files_of, number_rows
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import Lens
from usdbrdf.options import CaptureOptions

NAME = "bundler"
DESCRIPTION = DESCRIPTIONS[NAME]
# A camera's rows and their numbers: focal length, k1, k2; rotation; translation.
_ROWS, _COUNTS = 5, 15
_LARGEST = 1_000_000  # cameras that a file may announce
# Where PMVS has the pictures, undistorted and numbered in this order (VisualSFM, COLMAP).
_UNDISTORTED = "visualize"
_FOLDER = "bundle"  # where Bundler itself puts them, below its list of pictures
_LISTS = "*list*.txt"
_MESHES = ("mesh.*", "model.*")
_OPENGL = np.diag([1.0, -1.0, -1.0])


def matches(path: Path) -> bool:
    """Such a file, or a folder with one or several of them, or with one in bundle/."""
    return bool(_documents(path))


def _documents(path: Path) -> list[Path]:
    """Those of Bundler's own name before others."""
    begun = re.compile(rb"\s*# *Bundle file|\s*\d+\s+\d+\s*\n")
    found = [
        file
        for file in files_of(path, [".out"]) + files_of(path / _FOLDER, [".out"])
        if (said := begun.match(beginning_in_utf8(file)))
        and (b"#" in said[0] or file.name == "bundle.out")
    ]
    return sorted(found, key=lambda file: (file.name != "bundle.out", file.name))


def read(path: Path, options: CaptureOptions) -> Scan:
    documents, findings = _documents(path.resolve()), Findings()
    if not documents:
        raise InputRefused(
            f"{path}: no .out that begins with '# Bundle file'. Name the one that was exported. "
            "[capture.format]"
        )
    source = documents[0]
    folder = _home(path)
    undistorted = (folder / _UNDISTORTED).is_dir()
    return scan_of_shots(
        shots_of(source, None if undistorted else _names(source, folder)),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        pictures_in=(_UNDISTORTED,) if undistorted else (),
        meshes=_MESHES,
        how="Export the mesh in the frame of these cameras into this folder",
    )


def beside(path: Path) -> list[Path]:
    """What lies above Bundler's own folder, where that is named."""
    home = _home(path)
    if home == capture_folder_of(path):
        return []
    return [*_lists(home), *files_of_capture(home, meshes=_MESHES)]


def _home(path: Path) -> Path:
    """The capture's folder: that above Bundler's own, where this is named and has not all."""
    folder = capture_folder_of(path)
    whole = (folder / _UNDISTORTED).is_dir() or bool(_lists(folder))
    return folder.parent if folder.name == _FOLDER and not whole else folder


def _lists(folder: Path) -> list[Path]:
    return seen_of(folder.glob(_LISTS))


def _names(source: Path, folder: Path) -> tuple[str, ...]:
    """The pictures, one a line, which may go on with what Bundler is to begin from."""
    stem = source.stem.removesuffix(".bundle")
    usual = [f"{stem}{mark}list.txt" for mark in (".", "_", "-")]
    named = (*usual, f"{source.name}.list.txt", "list.txt")
    places = [place / name for place in (source.parent, folder) for name in named]
    found = next((p for p in (*places, *_lists(folder)) if p.is_file()), None)
    if found is None:
        raise InputRefused(
            f"{source}: no {usual[0]} or list.txt beside it, which says of which pictures its "
            "cameras are. Bring the list that was exported with it. [capture.format]"
        )
    lines = (line.strip() for line in read_text(found).splitlines())
    return tuple(re.sub(r"(\s+\d+\s+[-+.\deE]+)$", "", line) for line in lines if line)


def shots_of(source: Path, names: tuple[str, ...] | None) -> list[Shot]:
    """The photographs of a document, by their numbers where they have no names."""
    head = number_rows(source, most=1)
    count = int(head[0][0]) if head and len(head[0]) == 2 and 0 <= head[0][0] < _LARGEST else -1
    if count < 0:
        raise InputRefused(
            f"{source}: no line at its beginning says how many cameras and points follow. It was "
            "cut off, or is of another format; export it again. [capture.format]"
        )
    rows = number_rows(source, most=1 + _ROWS * count)[1:]
    numbers = np.concatenate(rows) if rows else np.zeros(0)
    if len(numbers) != _COUNTS * count:
        raise InputRefused(
            f"{source}: {len(rows) // _ROWS} cameras of {_COUNTS} numbers where it announces "
            f"{count}. It was cut off, or is of another format; export it again. "
            "[capture.format]"
        )
    if names is None:
        names = tuple(f"{i:08d}" for i in range(count))
    if len(names) != count:
        raise InputRefused(
            f"{source}: {count} cameras, but {len(names)} pictures in the list beside it, so "
            "nobody knows which is whose. Bring the list of the same export. [capture.format]"
        )
    cameras = numbers.reshape(-1, _COUNTS)
    return [_shot(name, camera) for name, camera in zip(names, cameras, strict=True)]


def _shot(name: str, numbers: Double) -> Shot:
    focal, k1, k2 = numbers[:3].tolist()
    # What was never placed has zeros.
    if not np.isfinite(numbers).all() or not focal > 0:
        return Shot(name=name, camera=None, world_from_camera=None)
    turn = _OPENGL @ numbers[3:12].reshape(3, 3)
    return Shot(
        name=name,
        camera=CentredCamera(focal=focal, lens=Lens(radial=(k1, k2))),
        world_from_camera=rigid_pose(turn.T, -turn.T @ (_OPENGL @ numbers[12:])),
    )
