"""What the frames show of the far surroundings: rays that miss the mesh measure them, direction by
direction, as rays that meet it measure its texels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.files.frames import FramePixels, read_frame, read_frames
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Array, Bool, Double, Float, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.texturing import psquare
from usdbrdf.texturing.psquare import QuantileState
from usdbrdf.transport.environment import directions_of_pixels, pixels_of_directions, solid_angles
from usdbrdf.transport.rays import RayScene

# Of the picture of the surroundings; three quarters of a degree, wider than what parallax in a
# scan some metres wide leaves of far things.
HEIGHT, WIDTH = 256, 512
# Pixels between the rays that look whether a frame shows anything but the mesh.
_STRIDE = 8
_LEAST_OUTSIDE = calibration.number("outside.least_seen")
_QUANTILE = 0.5
_LEAST_SKY = calibration.number("outside.least_sky")
_SLOPE = calibration.pair("outside.sky_slope")
_SCATTER = calibration.number("outside.sky_scatter")
_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Of D = HEIGHT x WIDTH directions: radiance (D, 3) float32, W/(m^2 sr), the median of what
    frames measured, what saturates them where all clip, 0 elsewhere; and the coverage."""

    radiance: Float
    coverage: CoverageMap

    @classmethod
    def unseen(cls) -> Surroundings:
        none = np.zeros(HEIGHT * WIDTH, np.bool_)
        return cls(
            radiance=np.zeros((HEIGHT * WIDTH, 3), np.float32), coverage=CoverageMap.of(none, none)
        )

    def trend(self, z_up: bool) -> Double:
        """(D, 3): what the other directions are likely to show: of what was measured above the
        horizon, the plane through the logarithms of its radiance over the direction's three
        coordinates, as skies darken away from the sun and from the horizon. Below the horizon it
        goes on as at it. The steeper it is for what little was measured, the less it is believed;
        where nothing was, it is the median of all."""
        directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
        up = 2 if z_up else 1
        usual = self.median()
        flat = directions.copy()
        flat[:, up] = np.maximum(flat[:, up], 0)
        sky = self.coverage.measured & (directions[:, up] > 0) & (self.radiance > 0).all(axis=1)
        solid = np.repeat(solid_angles(HEIGHT, WIDTH), WIDTH)[sky]
        if solid.sum() < _LEAST_SKY:
            return np.tile(usual, (len(sky), 1))
        log = np.log(self.radiance[sky].astype(np.float64))
        weight = solid / solid.sum()
        centre, level = weight @ flat[sky], weight @ log
        off, value = flat[sky] - centre, log - level
        spread, both = (off * weight[:, None]).T @ off, (off * weight[:, None]).T @ value
        # As many independent places as there are patches of this size.
        places = solid.sum() / _LEAST_SKY
        slope, steep = np.zeros((3, 3)), np.full(3, _SLOPE[1])
        steep[up] = _SLOPE[0]
        for _ in range(_STEPS):
            scatter = (weight[:, None] * (value - off @ slope) ** 2).sum(axis=0)
            for c in range(3):
                noise = max(float(scatter[c]), _SCATTER**2) / places
                slope[:, c] = np.linalg.solve(spread + noise * np.diag(steep**-2), both[:, c])
        return np.asarray(np.exp(level + (flat - centre) @ slope), np.float64)

    def median(self) -> Double:
        """(3,) of what was measured, 0 without any."""
        known = self.radiance[self.coverage.measured].astype(np.float64)
        return np.median(known, axis=0) if len(known) else np.zeros(3)


def share_outside(rays: RayScene, frames: Frames) -> Float:
    """(N,) share of each frame's pixels that show no surface."""
    shares = []
    for i in range(len(frames)):
        camera = frames.camera(i)
        hits = rays.closest(*camera.rays(camera.pixels(_STRIDE)))
        shares.append((hits.face < 0).mean())
    return np.array(shares, np.float32)


def surroundings_from_frames(rays: RayScene, frames: Frames, z_up: bool) -> Surroundings:
    """All that the frames show beside the mesh; nothing where they hardly look past it."""
    shares = share_outside(rays, frames)
    if shares.mean() < _LEAST_OUTSIDE:
        return Surroundings.unseen()
    state = QuantileState.empty(HEIGHT * WIDTH)
    saturates = np.zeros(HEIGHT * WIDTH, np.float32)
    looking = np.flatnonzero(shares > 0).tolist()
    images = read_frames(partial(read_frame, frames), looking)
    for i, pixels in progress(images, total=len(looking), label="shade: outside", unit="frames"):
        direction, radiance, clipped = _seen_in_frame(rays, frames.camera(i), pixels, z_up)
        psquare.update(state, direction, radiance, _QUANTILE)
        limit = np.float32(frames.saturation_radiance[i])
        saturates[clipped] = np.maximum(saturates[clipped], limit)
    measured = state.samples > 0
    found = np.where(
        measured[:, None], psquare.quantile(state, _QUANTILE), saturates[:, None]
    ).astype(np.float32)
    return Surroundings(
        radiance=found, coverage=CoverageMap.of(measured, ~measured & (saturates > 0))
    )


def _seen_in_frame(
    rays: RayScene, camera: Camera, pixels: FramePixels, z_up: bool
) -> tuple[Array, Float, Long]:
    """Directions of which one frame shows all valid pixels, (M,) int32, and their mean (M, 3);
    and those of which it shows saturated ones alone, (K,)."""
    # Four pixels to a direction's side are enough.
    step = max(1, int(camera.intrinsics[0] * np.pi / HEIGHT / 4))
    _, towards = camera.rays(camera.pixels(step))
    valid, clipped = pixels.valid[::step, ::step], pixels.clipped[::step, ::step]
    shown = pixels.radiance[::step, ::step]
    faces = rays.closest(camera.eye[None].astype(np.float32), towards).face
    miss = (faces < 0).reshape(valid.shape)
    # A pixel beside the mesh shows some of it.
    alone: Bool = ndimage.binary_erosion(miss, np.ones((3, 3)))
    which = np.flatnonzero(alone)
    place = pixels_of_directions(towards[which], HEIGHT, WIDTH, z_up)
    count, num_valid, num_clipped = (
        np.bincount(place, weights, HEIGHT * WIDTH)
        for weights in (None, valid.ravel()[which], clipped.ravel()[which])
    )
    whole = np.flatnonzero((count > 0) & (num_valid == count))
    brought = np.nan_to_num(shown.reshape(-1, 3)[which])
    sums = [np.bincount(place, brought[:, c], HEIGHT * WIDTH)[whole] for c in range(3)]
    mean = (np.stack(sums, axis=-1) / count[whole, None]).astype(np.float32)
    return whole.astype(np.int32), mean, np.flatnonzero((count > 0) & (num_clipped == count))
