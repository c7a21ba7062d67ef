"""Camera raw files, DNG and what LibRaw knows: what the sensor recorded, the camera's colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.model.arrays import Double, Float
from usdbrdf.untrusted.bounds import read_in_child

_CODES = 65_535
# Linear Rec.709 to XYZ under D65 (IEC 61966-2-1), of which colour matrices of cameras are inverses.
_XYZ_FROM_REC709 = np.array([
    [0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
    [0.0193339, 0.1191920, 0.9503041],
])  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RawPicture:
    """One raw file.

    sensor         (H, W, 3) float32: the three channels in the sensor's own colours and
                   orientation, 0 at its black level and 1 at saturation, before any white balance
    crop           left, top, width and height of the part of it that the file says is the picture,
                   as the camera's own JPEG shows it; all of it where the file says nothing
    white_balance  (3,) float64, factors as shot, of which green's is 1
    rec709_from_camera  (3, 3) float64, of balanced channels; white stays white
    exposure       time in seconds x ISO / 100 / f-number^2, as far as the file tells; None
                   without a time
    """

    sensor: Float
    crop: tuple[int, int, int, int]
    white_balance: Double
    rec709_from_camera: Double
    exposure: float | None


def raw_picture(path: Path) -> RawPicture:
    """The picture of a raw file; EnvironmentFailure without rawpy, InputRefused for a file that
    LibRaw cannot read whole or whose colours it does not know."""
    if find_spec("rawpy") is None:
        raise EnvironmentFailure(
            f"{path}: camera raw files are read with rawpy, which is not installed. Install it "
            "with: pip install 'usdbrdf[raw]'. [environment.rawpy]"
        )
    return read_in_child("picture", f"{__name__}:read_here", path, RawPicture)


def read_here(path: Path) -> RawPicture:
    """``raw_picture`` in this process, which is to be a child."""
    import rawpy

    try:
        with rawpy.imread(str(path)) as raw:
            given = np.array(raw.camera_whitebalance[:3], np.float64)
            if raw.num_colors != 3 or not (np.isfinite(given).all() and (given > 0).all()):
                raise InputRefused(
                    f"{path}: a raw file without three colours and their white balance. Develop it "
                    "to a scene-linear EXR. [raw.colours]"
                )
            matrix = _rec709_from_camera(path, raw.rgb_xyz_matrix[:3], raw.color_matrix[:, :3])
            shot, sizes = raw.other, raw.sizes
            # The largest factor is 1 then: no channel is cut off below its own saturation.
            codes = raw.postprocess(
                output_color=rawpy.ColorSpace.raw,
                user_wb=[*given, given[1]],
                highlight_mode=rawpy.HighlightMode.Ignore,
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                output_bps=16,
                user_flip=0,
            )
    except rawpy.LibRawError as error:
        said = " ".join(str(error).split())[:160]
        raise InputRefused(
            f"{path}: LibRaw cannot read it ({said}). Copy it again, or develop it to a "
            "scene-linear EXR. [raw.read]"
        ) from error
    sensor = codes.astype(np.float32) / np.float32(_CODES)
    sensor /= (given / given.max()).astype(np.float32)
    time, speed, number = (float(v) for v in (shot.shutter_speed, shot.iso_speed, shot.aperture))
    known = math.isfinite(time) and time > 0
    exposure = time * ((speed if speed > 0 else 100) / 100) / (number if number > 0 else 1) ** 2
    return RawPicture(
        sensor=sensor,
        crop=_crop(sizes, *sensor.shape[:2]),
        white_balance=given / given[1],
        rec709_from_camera=matrix,
        exposure=exposure if known else None,
    )


def _crop(sizes: Any, rows: int, columns: int) -> tuple[int, int, int, int]:
    """``RawPicture.crop`` of so many rows and columns, which are the sensor without its margins;
    LibRaw counts from its corner, margins and all, and says 0 where the file states none."""
    left = sizes.crop_left_margin - sizes.left_margin
    top = sizes.crop_top_margin - sizes.top_margin
    width, height = sizes.crop_width, sizes.crop_height
    inside = 0 <= left <= columns - width and 0 <= top <= rows - height
    # Pixels that are not square, and sensors that are turned by 45 degrees, have been resampled.
    as_stored = (rows, columns) == (sizes.height, sizes.width)
    if not (inside and as_stored and width > 0 and height > 0):
        return 0, 0, columns, rows
    return left, top, width, height


def _rec709_from_camera(path: Path, camera_from_xyz: Double, given: Double) -> Double:
    """From LibRaw's table of cameras, else as the file gives it."""
    if np.abs(camera_from_xyz).sum() > 0:
        camera = np.asarray(camera_from_xyz, np.float64) @ _XYZ_FROM_REC709
        return np.linalg.inv(camera / camera.sum(axis=1, keepdims=True))
    matrix = np.asarray(given, np.float64)
    if not (np.isfinite(matrix).all() and np.abs(matrix.sum(axis=1) - 1).max() < 0.01):
        raise InputRefused(
            f"{path}: neither the file nor LibRaw knows the colours of this camera. Convert it to "
            "DNG, or develop it to a scene-linear EXR. [raw.colours]"
        )
    return matrix
