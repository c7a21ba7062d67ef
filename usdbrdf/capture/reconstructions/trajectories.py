"""What trajectories have in common: poses that are counted, pictures that are counted too, from the
same number or not, and pinholes as matrices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from usdbrdf.capture.checks import Findings
from usdbrdf.capture.formats.named_pictures import Pictures
from usdbrdf.capture.reconstructions.shots import Shot, ShotCamera, UnsizedCamera
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.errors import InputRefused
from usdbrdf.files.tables import numbers_among
from usdbrdf.model.arrays import Double

# Pictures that may be lacking at the end of all that are counted one by one, as those that an
# encoder loses, in parts of the poses.
_LOST = 0.01


def pinhole_of(matrix: object, centre: float = 0.0) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy of nine numbers column by column, or row by row as people write them; None of
    what is no such matrix.

    centre  where the middle of the first pixel is to be, more than there
    """
    numbers = numbers_among(matrix, 9)
    if numbers is None:
        return None
    rows = numbers.reshape(3, 3)
    rows = rows if rows[:2, 2].all() and not rows[2, :2].any() else rows.T
    (fx, _, cx), (_, fy, cy), _ = rows.tolist()
    return (fx, fy, cx + centre, cy + centre) if min(fx, fy) > 0 else None


def poses_of(rows: Iterable[Double | None]) -> list[Double | None]:
    """World from camera of a quaternion (x, y, z, w) and a place each, in the axes that they have;
    None of what is none."""
    return [
        rigid_pose(Rotation.from_quat(row[:4]).as_matrix(), row[4:])
        if row is not None and np.linalg.norm(row[:4]) > 0.5
        else None
        for row in rows
    ]


def counted_pictures(
    pictures: Pictures, count: int, source: Path, findings: Findings
) -> list[tuple[int, Path]]:
    """The pictures of so many poses, each with the number of its own: as many in their order, of
    fewer by the number at the end of their names, from 0 or 1 on. InputRefused where nobody knows
    whose they are."""
    numbered = pictures.numbered()
    if not pictures.paths or len(numbered) == count:
        return list(enumerate(numbered.values()))
    if len(pictures.paths) == count:
        return list(enumerate(pictures.paths))
    first, last = min(numbered, default=-1), max(numbered, default=count)
    start = int(first > 0 and last == count)
    whole = last - first + 1 == len(numbered) and first <= 1
    if last - start >= count:
        called = f"numbered {first} to {last}" if numbered else "without numbers in their names"
        raise InputRefused(
            f"{source}: {count} poses for {len(pictures.paths)} pictures {called}, so nobody knows "
            "which is whose. Bring all pictures of this trajectory, and no others. "
            "[capture.frames]"
        )
    if whole and last - start < (1 - _LOST) * count - 1:
        raise InputRefused(
            f"{source}: {count} poses, but {len(numbered)} pictures that are counted one by one "
            f"from {first}, as of a video of which every so many were extracted, so nobody knows "
            "which pose is whose. Extract all, and delete those that are not needed. "
            "[capture.frames]"
        )
    if first > 0 and not start:
        findings.warn(
            f"{source.name}: {len(numbered)} pictures for {count} poses, numbered {first} to "
            f"{last}, are taken to be counted from 0, as the poses are. If they were counted from "
            "1, extract them again. [capture.frames]"
        )
    return [(number - start, picture) for number, picture in numbered.items()]


def shots_of_numbers(
    counted: Iterable[tuple[int, Path]],
    poses: Sequence[Double | None],
    cameras: Sequence[ShotCamera | UnsizedCamera | None],
    pictures: Pictures,
) -> list[Shot]:
    """One for each picture, with the pose (OpenCV's axes) and camera of its number, if there are
    any; the only camera where there is one."""
    cameras = [*cameras] * len(poses) if len(cameras) == 1 else cameras
    return [
        Shot(
            name=picture.relative_to(pictures.folder).as_posix(),
            camera=cameras[i] if i < len(cameras) else None,
            world_from_camera=poses[i] if i < len(poses) else None,
        )
        for i, picture in counted
    ]
