"""What is photographed: pinhole cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Double = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class View:
    """A pinhole camera and the size of its picture.

    world_from_camera  (4, 4) metres; x right, y up, looks down -z
    intrinsics         fx, fy, cx, cy in pixels, first pixel's centre at (0.5, 0.5), y down
    """

    name: str
    world_from_camera: Double
    intrinsics: tuple[float, float, float, float]
    width: int
    height: int

    def at_width(self, width: int) -> View:
        """The same picture with another number of pixels."""
        height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.intrinsics
        lens = (fx * x, fy * y, cx * x, cy * y)
        return replace(self, intrinsics=lens, width=width, height=height)
