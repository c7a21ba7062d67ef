"""ARKitScenes: the folder of a video, raw or of its part 3dod, with lowres_wide.traj, pictures with
their .pincam, and the mesh.

A row of the trajectory is a time and what leads from the world, z up, in metres, to the camera
(OpenCV's axes): axis times angle, and a translation. Pictures are called by their times; cameras
have one of their own for each. Pixel centres are whole numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import compress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.named_pictures import SUFFIXES, pictures_of
from usdbrdf.capture.reconstructions.shots import (
    Shot,
    ShotCamera,
    capture_folder_of,
    files_of_capture,
    scan_of_shots,
)
from usdbrdf.capture.reconstructions.trajectories import originals_of
from usdbrdf.errors import InputRefused
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import files_of, number_in, number_rows, only_one
from usdbrdf.model.arrays import Bool, Double
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.mesh_files import SUFFIXES as MESH_SUFFIXES

NAME = "arkitscenes"
DESCRIPTION = DESCRIPTIONS[NAME]
_TRAJECTORY, _FRAMES = "lowres_wide.traj", "_frames"
# Folders of pictures, the largest first; the ultra-wide camera's poses are not published.
_PICTURES = ("wide", "vga_wide", "lowres_wide")
_MESHES = ("*_3dod_mesh.ply", "mesh.*")
_COUNTS = 7, 6  # numbers of a pose with its time, and of a .pincam
# Seconds between poses, ten in each, that are still neighbours; between a picture and a pose with
# no neighbour there, as the data set's own tools have it; between a picture and its camera, whose
# names are rounded apart; and within which a name in whole ms may be the pose's own.
_BETWEEN_POSES, _BETWEEN, _ROUNDED, _SAME_MS = 0.12, 0.005, 0.0015, 0.00051


def matches(path: Path) -> bool:
    """The trajectory, a folder with it, or with a folder of frames that has it."""
    return bool(_trajectories(path))


def _trajectories(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path] if path.name == _TRAJECTORY and path.is_file() else []
    places = (_TRAJECTORY, f"*{_FRAMES}/{_TRAJECTORY}")
    return [file for place in places for file in seen_of(path.glob(place)) if file.is_file()]


def _home(path: Path) -> Path:
    """The capture's folder: that of the video, where its frames' folder is named; one that is only
    called so has the mesh itself."""
    folder = capture_folder_of(path)
    if not folder.name.endswith(_FRAMES) or files_of(folder, MESH_SUFFIXES):
        return folder
    return folder.parent


def read(path: Path, options: CaptureOptions) -> Scan:
    found, findings, folder = _trajectories(path.resolve()), Findings(), _home(path)
    source = only_one(found, path, _TRAJECTORY, "Name the folder of one video")
    return scan_of_shots(
        shots_of(source, options, findings),
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        pictures_in=_places(source, folder),
        meshes=_MESHES,
        how="Download the video's asset mesh, VIDEO_3dod_mesh.ply, into this folder",
        up_axis="Z",
        in_metres=True,
    )


def beside(path: Path) -> list[Path]:
    """What lies above the folder of frames, where that is named."""
    home = _home(path)
    return [] if home == capture_folder_of(path) else files_of_capture(home, meshes=_MESHES)


def _places(source: Path, folder: Path) -> tuple[str, ...]:
    """The folder of pictures, below the capture's: the first that has any, with cameras beside."""
    inside = source.parent.relative_to(folder)
    whole = (
        name
        for name in _PICTURES
        if files_of(source.parent / name, SUFFIXES)
        and files_of(source.parent / f"{name}_intrinsics", [".pincam"])
    )
    return ((inside / next(whole, _PICTURES[-1])).as_posix(),)


def shots_of(source: Path, options: CaptureOptions, findings: Findings) -> list[Shot]:
    """The pictures that a pose of the trajectory was taken with."""
    rows = number_rows(source)
    if not rows or any(len(row) != _COUNTS[0] for row in rows):
        raise InputRefused(
            f"{source}: not rows of a time and six numbers. Download it again. [capture.format]"
        )
    folder = _home(source)
    places = _places(source, folder)
    cameras = _by_time(seen_of((folder / f"{places[0]}_intrinsics").glob("*.pincam")))
    found_there = originals_of(pictures_of(folder, options, *places), source, findings)
    pictures = sorted(_by_time(found_there.paths).items())
    known, poses = _poses_at(np.array([time for time, _ in pictures]), np.stack(rows))
    found = []
    for (time, picture), pose in zip(pictures, poses, strict=True):
        nearest = min(cameras, key=lambda other: abs(other - time), default=np.inf)
        near = abs(nearest - time) <= _ROUNDED
        found.append(
            Shot(
                name=picture.name,
                camera=_camera(cameras[nearest]) if near else None,
                world_from_camera=pose,
            )
        )
    apart = len(pictures) - int(known.sum())
    if pictures and not known.any():
        raise InputRefused(
            f"{source}: none of the {apart} pictures, first {pictures[0][1].name!r}, was taken "
            "when it has poses. Download pictures and trajectory of one video. [capture.alignment]"
        )
    if apart:
        findings.warn(
            f"{source.name}: {apart} pictures were taken between its poses, and are passed over. "
            "[capture.unused]"
        )
    return list(compress(found, known))


def _by_time(files: Iterable[Path]) -> dict[float, Path]:
    """Files by the time at the end of their names, those without left out."""
    times = {file: number_in({"": file.stem.rpartition("_")[2]}, "") for file in files}
    return {time: file for file, time in times.items() if time is not None}


def _poses_at(times: Double, rows: Double) -> tuple[Bool, Double]:
    """Which (N,) times the trajectory has a pose for, and the poses (N, 4, 4), world from camera:
    between two rows that are neighbours in time evenly turned and moved, else the nearest row's."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if not len(rows) or not len(times):
        return np.zeros(len(times), np.bool_), np.tile(np.eye(4), (len(times), 1, 1))
    turns, taken = Rotation.from_rotvec(rows[:, 1:4]).inv(), rows[:, 0]
    centres = -turns.apply(rows[:, 4:])
    after = np.minimum(np.searchsorted(taken, times), len(rows) - 1)
    before = np.maximum(after - 1, 0)
    gap, since, until = taken[after] - taken[before], times - taken[before], taken[after] - times
    nearest = np.minimum(abs(since), abs(until))
    within = (since >= 0) & (until >= 0) & (gap <= _BETWEEN_POSES)
    even = within & (nearest > _SAME_MS)
    share = np.where(even, since / np.where(even, gap, 1), abs(until) < abs(since))[:, None]
    steps = (turns[before].inv() * turns[after]).as_rotvec()
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3] = (turns[before] * Rotation.from_rotvec(share * steps)).as_matrix()
    poses[:, :3, 3] = (1 - share) * centres[before] + share * centres[after]
    return within | (nearest <= _BETWEEN), poses


def _camera(file: Path) -> ShotCamera | None:
    rows = number_rows(file)
    if len(rows) != 1 or len(rows[0]) != _COUNTS[1] or not np.isfinite(rows[0]).all():
        return None
    width, height, fx, fy, cx, cy = rows[0].tolist()
    return ShotCamera(resolution=(int(width), int(height)), intrinsics=(fx, fy, cx + 0.5, cy + 0.5))
