"""The light that comes from outside the scan: black, or a latitude-longitude HDR picture."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usdbrdf.kernel import kernel
from usdbrdf.model.arrays import Float


class Environment(NamedTuple):
    """Radiance of the far surroundings.

    image   (H, W, 3) float32; OpenEXR's and UsdLux's latitude-longitude layout: the top row is the
            pole of the up axis, the middle column looks along +z of a y-up world
    z_up    True if the world's up axis is z; the picture is then turned by 90 degrees about x
    """

    image: Float
    z_up: bool


def black_environment() -> Environment:
    return Environment(image=np.zeros((1, 1, 3), np.float32), z_up=False)


@kernel
def environment_at(environment: Environment, x: float, y: float, z: float, channel: int) -> float:
    """Radiance from the unit direction (x, y, z); nearest pixel; for use inside kernels."""
    image, z_up = environment.image, environment.z_up
    height, width, _ = image.shape
    up = z if z_up else y
    ahead = -y if z_up else z
    row = int((0.5 - np.arcsin(min(1.0, max(-1.0, up))) / np.pi) * height)
    column = int((0.5 - np.arctan2(x, ahead) / (2 * np.pi)) * width)
    value: float = image[min(row, height - 1), min(max(column, 0), width - 1), channel]
    return value
