"""What trajectories have in common: poses that are counted, pictures that are counted too, from the
same number or not, and pinholes as matrices."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from decimal import Decimal
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
# And where some were deleted, so that it is not so plain how they were counted.
_DELETED = 0.1
_OFF_LENGTH = 0.01  # of a quaternion from 1, as few digits leave it
_NUMBER = re.compile(r"(\d{6,}\.\d+|\d+)")  # of names: seconds with a fraction, else whole


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
        if row is not None and _is_turn(row[:4])
        else None
        for row in rows
    ]


def _is_turn(quaternion: Double) -> bool:
    # Of larger numbers the length may be none.
    return bool(np.abs(quaternion).max() < 2 and abs(np.linalg.norm(quaternion) - 1) < _OFF_LENGTH)


def originals_of(pictures: Pictures, source: Path, findings: Findings) -> Pictures:
    """The pictures that are no copies of others, with a sentence on those that are."""
    kept = set(pictures.originals.paths)
    if passed := [path for path in pictures.paths if path not in kept]:
        findings.warn(
            f"{source.name}: {len(passed)} of {len(pictures.paths)} pictures are left out as "
            f"copies of others, such as {passed[0].relative_to(pictures.folder)}. Take them away, "
            "or call them otherwise if they are none. [capture.frames]"
        )
    return pictures.originals


def counted_pictures(
    pictures: Pictures, numbers: Sequence[int], source: Path, findings: Findings
) -> list[tuple[int, Path]]:
    """The pictures of poses that have these numbers, in their order, each with the place of its own
    pose, one behind the last where it has none. As many pictures as poses, or as their numbers
    count, are theirs one by one; fewer are those of the numbers at the end of their names.
    Copies are told, and left out. InputRefused where nobody knows whose they are."""
    pictures = originals_of(pictures, source, findings)
    each, count = pictures.of_each_name(), max(numbers, default=-1) + 1
    if len(each) in (0, len(numbers), count):
        in_order = sorted(each, key=lambda path: _natural(path.relative_to(pictures.folder)))
        numbered = dict(enumerate(in_order))
    else:
        numbered = _from_0(pictures, len(each), numbers, source, findings)
    if len(each) == len(numbers):
        return [*numbered.items()]
    place = {number: i for i, number in enumerate(numbers)}
    return [(place.get(number, len(numbers)), picture) for number, picture in numbered.items()]


def _natural(path: Path) -> list[str | Decimal]:
    """In whose order 2 comes before 10, and a time before one of more seconds."""
    parts = _NUMBER.split(path.with_suffix("").as_posix())
    return [Decimal(part) if i % 2 else part for i, part in enumerate(parts)]


def _from_0(
    pictures: Pictures, num_pictures: int, numbers: Sequence[int], source: Path, findings: Findings
) -> dict[int, Path]:
    """Pictures by the numbers at the end of their names, counted from 0 as those of the poses."""
    numbered, count = pictures.numbered(), max(numbers, default=-1) + 1
    first, last = min(numbered, default=-1), max(numbered, default=count)
    start = int(first > 0 and last == count)
    called = f"numbered {first} to {last}" if numbered else "without numbers in their names"
    is_whole = last - first + 1 == len(numbered)
    is_dense = first <= 1 and 2 * len(numbered) > last - first + 2
    some = _LOST if is_whole else _DELETED
    said = ""
    if len({tuple(re.findall(r"\d+", p.stem)[:-1]) for p in numbered.values()}) > 1:
        said = (
            "whose names have several numbers, as of times, so nobody knows which is whose. Bring "
            "a picture of every pose, and no others"
        )
    elif len(numbered) == count:
        return dict(enumerate(numbered.values()))
    elif last - start >= count:
        said = (
            f"{called}, so nobody knows which is whose. Bring all pictures of this trajectory, and "
            "no others"
        )
    elif is_dense and last - start < (1 - some) * count - 1:
        said = (
            f"{called}, as of a video of which every so many were extracted, so nobody knows which "
            "pose is whose. Extract all, and delete those that are not needed, but not the last"
        )
    elif is_dense and first == 1 and not start and 0 in numbers:
        said = (
            f"{called}, and nobody knows whether they are counted from 0 as the poses are, or from "
            "1. Extract all again from 0 on, and delete those that are not needed"
        )
    if said:
        raise InputRefused(
            f"{source}: {len(numbers)} poses for {num_pictures} pictures {said}. [capture.frames]"
        )
    if first > 0 and not start and 0 in numbers:
        findings.warn(
            f"{source.name}: {len(numbered)} pictures for {len(numbers)} poses, numbered {first} "
            f"to {last}, are taken to be counted from 0, as the poses are. If they were counted "
            "from 1, extract them again. [capture.frames]"
        )
    return {number - start: picture for number, picture in numbered.items()}


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
