"""Frames of a video by their numbers, decoded in a child process by FFmpeg."""

from __future__ import annotations

import errno
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import environment_failures, sha256_of
from usdbrdf.files.images import MAX_PIXELS, MAX_SIDE, write_preview_png
from usdbrdf.model.arrays import Byte
from usdbrdf.untrusted.bounds import read_in_child

# Containers that hold their own frames; others are lists of further files and addresses.
_CONTAINERS = "mov,matroska,avi,mpegts,mpeg,mxf"
# What the machine lacks, of what FFmpeg reports; the rest is the file's.
_OF_THE_MACHINE = (errno.ENOMEM, errno.ESTALE, errno.ENOSPC)
# ITU-T H.273: primaries that are BT.709's or nearly so, curves of high dynamic range (PQ and HLG),
# and what says nothing of the matrix, which is BT.709's then from so many rows on, as players do.
_PRIMARIES, _HIGH_RANGE, _UNSAID, _LARGE_ROWS = (0, 1, 2, 5, 6, 7), (16, 18), (2, 3), 720
# Frames a video may have: two hours of 60 a second.
MOST_FRAMES = 432_000


@dataclass(frozen=True, kw_only=True)
class VideoFrames:
    """What was decoded: the numbers that were asked for and are there, from 0 on, in order, and
    width and height as they are shown."""

    numbers: tuple[int, ...]
    resolution: tuple[int, int]


def frames_of_video(path: Path, numbers: Sequence[int], folder: Path) -> VideoFrames:
    """Write some frames of a video as 8-bit PNG into ``folder``, as ``place_of`` names them.

    Raises EnvironmentFailure without PyAV, InputRefused for what FFmpeg cannot decode.
    """
    if find_spec("av") is None:
        raise EnvironmentFailure(
            f"{path}: videos are read with PyAV, which is not installed. Install it with: pip "
            "install 'usdbrdf[video]'. [environment.av]"
        )
    given = {"numbers": sorted(set(numbers)), "folder": str(folder.resolve())}
    return read_in_child("video", f"{__name__}:read_here", path, VideoFrames, parameters=given)


def place_of(folder: Path, number: int) -> Path:
    """Where a frame is written."""
    return folder / f"{number:06d}.png"


def read_here(path: Path, numbers: Sequence[int], folder: str) -> VideoFrames:
    """``frames_of_video`` in this process, which is to be a child."""
    import av

    wanted, size = set(numbers), (0, 0)
    found: list[int] = []
    bounded = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file"}
    try:
        with av.open(str(path), container_options=bounded) as container:
            if not container.streams.video:
                raise _unreadable(path, "no stream of pictures")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            _refuse_wide_pixels(path, stream.sample_aspect_ratio)
            for number, frame in enumerate(container.decode(stream)):
                if number > min(max(wanted, default=0), MOST_FRAMES):
                    break
                if max(frame.width, frame.height) > MAX_SIDE:
                    raise _unreadable(path, f"frames of {frame.width} x {frame.height} pixels")
                if number in wanted and not frame.is_corrupt:
                    picture = _upright(path, frame)
                    shape = picture.shape[1], picture.shape[0]
                    if found and shape != size:
                        raise _unreadable(path, "frames of several sizes")
                    size = shape
                    write_preview_png(place_of(Path(folder), number), picture)
                    found.append(number)
    except (av.FFmpegError, ValueError, EOFError) as error:
        if getattr(error, "errno", None) in _OF_THE_MACHINE:
            raise
        if getattr(error, "errno", None) == errno.EIO:
            # FFmpeg says so of damage too; a disk that fails does so again.
            with environment_failures(str(path)):
                sha256_of(path)
        raise _unreadable(path, " ".join(str(error).split())[:160]) from error
    return VideoFrames(numbers=tuple(found), resolution=size)


def _upright(path: Path, frame: Any) -> Byte:
    """(H, W, 3) as players show it, of BT.709's primaries; InputRefused for others."""
    from av.video.reformatter import Colorspace

    _refuse_other_colours(path, frame)
    if frame.width * frame.height > MAX_PIXELS:
        raise _unreadable(path, f"frames of {frame.width} x {frame.height} pixels")
    quarters, rest = divmod(round(frame.rotation), 90)
    unsaid = int(frame.colorspace) in _UNSAID
    usual = Colorspace.ITU709 if frame.height >= _LARGE_ROWS else Colorspace.ITU601
    matrix = {"src_colorspace": usual} if unsaid else {}
    picture = frame.to_ndarray(format="rgb24", **matrix)
    return np.ascontiguousarray(np.rot90(picture, quarters if rest == 0 else 0), np.uint8)


def _refuse_wide_pixels(path: Path, ratio: Fraction | None) -> None:
    if ratio and ratio != 1:
        raise InputRefused(
            f"{path}: its pixels are not square ({ratio} as wide as high). Export it with square "
            "ones. [video.pixels]"
        )


def _refuse_other_colours(path: Path, frame: Any) -> None:
    curve = int(frame.color_trc)
    if int(frame.color_primaries) not in _PRIMARIES or curve in _HIGH_RANGE:
        what = {16: "PQ", 18: "HLG"}.get(curve, f"primaries {int(frame.color_primaries)} of H.273")
        raise InputRefused(
            f"{path}: its colours are not those of BT.709 ({what}). Record without HDR, or convert "
            "it to BT.709. [video.colour]"
        )


def _unreadable(path: Path, why: str) -> InputRefused:
    return InputRefused(
        f"{path}: FFmpeg cannot read it ({why}). Copy it again, or export it as MP4 or MOV. "
        "[video.read]"
    )
