"""One photograph as an adapter found it, before anything is checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from usdbrdf.scan.scan import Frames

Double = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """The row of ``Frames`` that one photograph becomes.

    name                  as the capture calls it, for messages
    image_path            absolute
    world_from_camera     (4, 4) float64, OpenGL axes, not yet known to be rigid
    intrinsics            fx, fy, cx, cy in pixels, first pixel's centre at (0.5, 0.5)
    resolution            width, height that the intrinsics belong to
    exposure_time         seconds; 1 where unknown
    saturation_radiance   infinite where unknown
    noise_floor_radiance  0 where unknown
    """

    name: str
    image_path: Path
    world_from_camera: Double
    intrinsics: tuple[float, float, float, float]
    resolution: tuple[int, int]
    exposure_time: float = 1.0
    saturation_radiance: float = math.inf
    noise_floor_radiance: float = 0.0


def frames_from_records(
    records: Sequence[FrameRecord], *, encoding: str, radiometric: bool
) -> Frames:
    """The records side by side."""
    return Frames(
        image_paths=tuple(r.image_path for r in records),
        world_from_camera=np.array([r.world_from_camera for r in records]).reshape(-1, 4, 4),
        intrinsics=np.array([r.intrinsics for r in records], np.float64).reshape(-1, 4),
        resolution=np.array([r.resolution for r in records], np.int32).reshape(-1, 2),
        exposure_time=np.array([r.exposure_time for r in records], np.float64),
        saturation_radiance=np.array([r.saturation_radiance for r in records], np.float64),
        noise_floor_radiance=np.array([r.noise_floor_radiance for r in records], np.float64),
        encoding=encoding,
        radiometric=radiometric,
    )
