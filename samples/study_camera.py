"""Where the camera stands, what its sensor makes of the light, and how frames are stored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import OpenImageIO as oiio

Array = npt.NDArray[np.float64]

WIDTH, HEIGHT = 192, 144
FOCAL = 140.0  # pixels: 69 degrees across
FRAME_COUNT = 54
EXPOSURES = (1 / 15, 1 / 60, 1 / 240)  # seconds, in turn
SATURATION_EXPOSURE = 0.8 / 15  # radiance times seconds at which a channel is full
FULL_WELL = 15_000.0  # electrons
READ_NOISE = 5.0  # electrons
LARGEST_NUMBER = 4095  # 12 bits
NOISE_FLOOR_NUMBER = 4  # below it a value is mostly read noise and rounding

CENTRE = np.array([1.9, 1.6])
ORBIT = np.array([1.2, 0.95])


def look_at(position: Array, target: Array) -> Array:
    """(4, 4) camera to world in OpenGL's axes: x right, y up, looks down -z; world z is up."""
    back = position - target
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return pose


def orbit_pose(turn: float, aim: int) -> Array:
    """A pose on the orbit, ``turn`` in revolutions, with one of five kinds of target."""
    angle = 2 * np.pi * turn
    side = ORBIT * [np.cos(angle), np.sin(angle)]
    across = -side / np.linalg.norm(side)
    oblique = np.array([[0.6, -0.8], [0.8, 0.6]]) @ across
    height = 1.4 + 0.42 * np.sin(2 * np.pi * 1.7 * turn + 0.6)
    position = np.array([*(CENTRE + side), height])
    targets = [
        (CENTRE, 0.35),  # the table
        (CENTRE + 1.6 * across, 1.25),  # the wall across
        (CENTRE + 0.7 * across, 0.0),  # the floor
        (CENTRE + 1.4 * oblique, 0.6),  # the furniture to the side
        (CENTRE + 1.5 * across, 2.2),  # the ceiling
    ]
    spot, z = targets[aim]
    return look_at(position, np.array([*spot, z]))


def frame_poses() -> list[Array]:
    # 2.3 revolutions: no azimuth comes back with the same exposure and target.
    return [orbit_pose(2.3 * k / FRAME_COUNT + 0.02, k % 5) for k in range(FRAME_COUNT)]


def held_out_poses() -> list[Array]:
    """Three poses that are not among the frames, towards the glossy things."""
    places = [
        ((0.95, 1.05, 1.35), (2.3, 2.0, 0.4)),
        ((2.75, 2.35, 1.6), (1.5, 1.0, 0.3)),
        ((1.3, 2.2, 1.2), (3.1, 0.75, 0.45)),
    ]
    return [look_at(np.array(p), np.array(t)) for p, t in places]


def saturation_radiance(exposure_time: float) -> float:
    return SATURATION_EXPOSURE / exposure_time


def noise_floor_radiance(exposure_time: float) -> float:
    return saturation_radiance(exposure_time) * NOISE_FLOOR_NUMBER / LARGEST_NUMBER


def photograph(radiance: Array, exposure_time: float, rng: np.random.Generator) -> Array:
    """What a 12-bit sensor reports of clean (H, W, 3) radiance, back in radiance.

    Photons arrive at random, reading adds noise, the well overflows and the converter rounds.
    """
    full = saturation_radiance(exposure_time)
    electrons = rng.poisson(np.minimum(radiance / full, 4.0) * FULL_WELL)
    electrons = electrons + rng.normal(0.0, READ_NOISE, radiance.shape)
    number = np.rint(electrons / FULL_WELL * LARGEST_NUMBER)
    return np.asarray(np.clip(number, 0, LARGEST_NUMBER) / LARGEST_NUMBER * full)


def write_exr(path: Path, radiance: Array, exposure_time: float | None = None) -> None:
    """(H, W, 3) scene-linear radiance as half RGB, losslessly compressed."""
    height, width, _ = radiance.shape
    spec = oiio.ImageSpec(width, height, 3, "half")
    spec.attribute("compression", "piz")  # a tenth smaller than zip on noisy frames
    spec.attribute("DateTime", "2000:01:01 00:00:00")  # else the writer puts the clock there
    if exposure_time is not None:
        spec.attribute("ExposureTime", float(exposure_time))
    output = oiio.ImageOutput.create(str(path))
    pixels = np.ascontiguousarray(radiance, dtype=np.float32)
    if not (output and output.open(str(path), spec) and output.write_image(pixels)):
        raise OSError(f"{path}: {output.geterror() if output else oiio.geterror()}")
    if not output.close():
        raise OSError(f"{path}: {output.geterror()}")
