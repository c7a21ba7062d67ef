"""ARKitScenes: the folder of a video, raw or of its part 3dod, with lowres_wide.traj, pictures with
their .pincam, and the mesh.

A row of the trajectory is a time and what leads from the world, z up, in metres, to the camera
(OpenCV's axes): axis times angle, and a translation. Pictures are called by their times; cameras
have one of their own for each. Pixel centres are whole numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.named_pictures import pictures_of, rigid_pose
from usdbrdf.capture.reconstructions.shots import (
    Shot,
    ShotCamera,
    capture_folder_of,
    files_of_capture,
    scan_of_shots,
)
from usdbrdf.errors import InputRefused
from usdbrdf.files.paths import seen_of
from usdbrdf.files.tables import number_in, number_rows
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "arkitscenes"
DESCRIPTION = DESCRIPTIONS[NAME]
_TRAJECTORY, _FRAMES = "lowres_wide.traj", "_frames"
# Folders of pictures, the largest first; the ultra-wide camera's poses are not published.
_PICTURES = ("wide", "vga_wide", "lowres_wide")
_MESHES = ("*_3dod_mesh.ply", "mesh.*")
_COUNTS = 7, 6  # numbers of a pose with its time, and of a .pincam
# Between the times of a picture and of its pose, as the data set's own tools have it; and of a
# picture and its camera, whose names are rounded apart.
_BETWEEN, _ROUNDED = 0.005, 0.0015


def matches(path: Path) -> bool:
    """A folder with the trajectory, or with a folder of frames that has it."""
    return bool(_trajectories(path))


def _trajectories(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    places = (_TRAJECTORY, f"*{_FRAMES}/{_TRAJECTORY}")
    return [file for place in places for file in seen_of(path.glob(place)) if file.is_file()]


def _home(path: Path) -> Path:
    """The capture's folder: that of the video, where its frames' folder is named."""
    folder = capture_folder_of(path)
    return folder.parent if folder.name.endswith(_FRAMES) else folder


def read(path: Path, options: CaptureOptions) -> Scan:
    found, findings, folder = _trajectories(path.resolve()), Findings(), _home(path)
    if len(found) != 1:
        raise InputRefused(
            f"{path}: {len(found) or 'no'} {_TRAJECTORY}. Name the folder of one video. "
            "[capture.format]"
        )
    (source,) = found
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
    """The folder of pictures, below the capture's: the first that has their cameras beside it."""
    inside = source.parent.relative_to(folder)
    whole = (
        name
        for name in _PICTURES
        if (source.parent / name).is_dir() and (source.parent / f"{name}_intrinsics").is_dir()
    )
    return ((inside / next(whole, _PICTURES[-1])).as_posix(),)


def shots_of(source: Path, options: CaptureOptions, findings: Findings) -> list[Shot]:
    """The pictures that a pose of the trajectory was taken with."""
    rows = number_rows(source)
    if not rows or any(len(row) != _COUNTS[0] for row in rows):
        raise InputRefused(
            f"{source}: not rows of a time and six numbers. Download it again. [capture.format]"
        )
    poses = np.stack(rows)
    folder = _home(source)
    places = _places(source, folder)
    cameras = _by_time(seen_of((folder / f"{places[0]}_intrinsics").glob("*.pincam")))
    found, apart = [], 0
    for time, picture in sorted(
        _by_time(list(pictures_of(folder, options, *places).paths)).items()
    ):
        pose = poses[np.abs(poses[:, 0] - time).argmin()]
        if abs(pose[0] - time) > _BETWEEN:
            apart += 1
            continue
        nearest = min(cameras, key=lambda other: abs(other - time), default=np.inf)
        near = abs(nearest - time) <= _ROUNDED
        found.append(
            Shot(
                name=picture.name,
                camera=_camera(cameras[nearest]) if near else None,
                world_from_camera=_pose(pose),
            )
        )
    if apart:
        findings.warn(
            f"{source.name}: {apart} pictures were taken between its poses, and are passed over. "
            "[capture.unused]"
        )
    return found


def _by_time(files: Iterable[Path]) -> dict[float, Path]:
    """Files by the time at the end of their names, those without left out."""
    times = {file: number_in({"": file.stem.rpartition("_")[2]}, "") for file in files}
    return {time: file for file, time in times.items() if time is not None}


def _pose(row: Double) -> Double | None:
    """(4, 4) world from camera."""
    if not np.isfinite(row).all():
        return None
    turn = Rotation.from_rotvec(row[1:4]).as_matrix().T
    return rigid_pose(turn, -turn @ row[4:])


def _camera(file: Path) -> ShotCamera | None:
    rows = number_rows(file)
    if len(rows) != 1 or len(rows[0]) != _COUNTS[1] or not np.isfinite(rows[0]).all():
        return None
    width, height, fx, fy, cx, cy = rows[0].tolist()
    return ShotCamera(resolution=(int(width), int(height)), intrinsics=(fx, fy, cx + 0.5, cy + 0.5))
