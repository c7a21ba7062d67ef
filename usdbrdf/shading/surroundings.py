"""What the frames show of the far surroundings: rays that miss the mesh measure them, direction by
direction, as rays that meet it measure its texels. That nothing is there is measured too, unless
nearly all of it is exactly zero: then somebody cut the surroundings out."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

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
_BLANK = calibration.number("outside.blank")
_QUANTILE = 0.5
_ABOVE_FLOOR = 2.0  # times the noise floor; it is some deviations of the noise already
_LEAST_FLOOR = 1e-12  # W/(m^2 sr), so that frames without noise weigh something finite
_LEAST_SKY = calibration.number("outside.least_sky")
_SLOPE = calibration.pair("outside.sky_slope")
_SCATTER = calibration.number("outside.sky_scatter")
_SHINES_AT_NIGHT = calibration.number("outside.shines_at_night")
_STEPS = 3


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Of D = HEIGHT x WIDTH directions: radiance (D, 3) float32, W/(m^2 sr), the median of what
    frames measured, the mean where all are too dark for that in some channel, what saturates them
    where all clip, 0 elsewhere; the coverage; and dark (D,), where they measured that hardly
    anything is there."""

    radiance: Float
    coverage: CoverageMap
    dark: Bool

    @classmethod
    def unseen(cls) -> Surroundings:
        none = np.zeros(HEIGHT * WIDTH, np.bool_)
        radiance = np.zeros((HEIGHT * WIDTH, 3), np.float32)
        return cls(radiance=radiance, coverage=CoverageMap.of(none, none), dark=none)

    def trend(self, z_up: bool) -> Double:
        """(D, 3): what the other directions are likely to show: of what was measured above the
        horizon, the plane through the logarithms of its radiance over the direction's three
        coordinates, as skies darken away from the sun and from the horizon. Below the horizon it is
        the median of what was measured there, or goes on as at the horizon. The steeper it is for
        what little was measured, the less it is believed; where nothing was, and by night, it is
        the median of all."""
        directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
        up = 2 if z_up else 1
        usual = self.median()
        flat = directions.copy()
        flat[:, up] = np.maximum(flat[:, up], 0)
        sky = self.coverage.measured & ~self.dark & (directions[:, up] > 0)
        sky &= (self.radiance > 0).all(axis=1)
        solid_of_each = np.repeat(solid_angles(HEIGHT, WIDTH), WIDTH)
        solid = solid_of_each[sky]
        if self.is_night() or solid.sum() < _LEAST_SKY:
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
        found = np.asarray(np.exp(level + (flat - centre) @ slope), np.float64)
        below = directions[:, up] < 0
        ground = self.coverage.measured & below
        if solid_of_each[ground].sum() >= _LEAST_SKY:
            found[below] = np.median(self.radiance[ground].astype(np.float64), axis=0)
        return found

    def is_night(self) -> bool:
        """Whether next to nothing shines of what was measured."""
        if not self.dark.any() or self.coverage.clipped.any():
            return False
        solid = np.repeat(solid_angles(HEIGHT, WIDTH), WIDTH) * self.coverage.measured
        return float((solid * ~self.dark).sum()) < _SHINES_AT_NIGHT * float(solid.sum())

    def median(self) -> Double:
        """(3,) of what was measured and is not dark, or of what is, as by night; 0 without any."""
        known = self.coverage.measured
        shines = known & ~self.dark
        known = shines if shines.any() and not self.is_night() else known
        if not known.any():
            return np.zeros(3)
        return np.asarray(np.median(self.radiance[known].astype(np.float64), axis=0))


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
    darkness, weight = np.zeros((HEIGHT * WIDTH, 3)), np.zeros(HEIGHT * WIDTH)
    floor = np.full(HEIGHT * WIDTH, np.inf)
    num_dark, num_blank = 0, 0
    looking = np.flatnonzero(shares > 0).tolist()
    images = read_frames(partial(read_frame, frames), looking)
    for i, pixels in progress(images, total=len(looking), label="shade: outside", unit="frames"):
        seen = _seen_in_frame(rays, frames.camera(i), pixels, z_up)
        psquare.update(state, seen.direction, seen.radiance, _QUANTILE)
        limit = np.float32(frames.saturation_radiance[i])
        saturates[seen.clipped] = np.maximum(saturates[seen.clipped], limit)
        floor[seen.dark] = np.minimum(floor[seen.dark], frames.noise_floor_radiance[i])
        own = max(float(frames.noise_floor_radiance[i]), _LEAST_FLOOR) ** -2.0
        darkness[seen.dark] += own * seen.darkness
        weight[seen.dark] += own
        num_dark += len(seen.dark)
        num_blank += int((seen.darkness == 0).all(axis=1).sum())
    measured = state.samples > 0
    dark = ~measured & (weight > 0) & (saturates == 0) & (num_blank < _BLANK * num_dark)
    found = np.where(measured[:, None], psquare.quantile(state, _QUANTILE), saturates[:, None])
    found[dark] = np.maximum(darkness[dark] / weight[dark, None], 0)
    measured |= dark
    # Where only some channels are too dark, as in a deep blue, it shines.
    dark &= found.max(axis=1) < _ABOVE_FLOOR * floor
    return Surroundings(
        radiance=found.astype(np.float32),
        coverage=CoverageMap.of(measured, ~measured & (saturates > 0)),
        dark=dark,
    )


class _SeenInFrame(NamedTuple):
    """Directions of which a frame shows all valid pixels, (M,) int32, and their mean (M, 3); those
    of which it shows saturated ones alone, (K,); and those with pixels that are too dark, (L,), and
    what they show all the same (L, 3)."""

    direction: Array
    radiance: Float
    clipped: Long
    dark: Long
    darkness: Float


def _seen_in_frame(rays: RayScene, camera: Camera, pixels: FramePixels, z_up: bool) -> _SeenInFrame:
    # Four pixels to a direction's side are enough.
    step = max(1, int(camera.intrinsics[0] * np.pi / HEIGHT / 4))
    _, towards = camera.rays(camera.pixels(step))
    part = np.s_[::step, ::step]
    valid, shown = pixels.valid[part], pixels.radiance[part]
    kinds = valid, pixels.clipped[part], pixels.dark[part] & ~pixels.clipped[part]
    faces = rays.closest(camera.eye[None].astype(np.float32), towards).face
    miss = (faces < 0).reshape(valid.shape)
    # A pixel beside the mesh shows some of it.
    alone: Bool = ndimage.binary_erosion(miss, np.ones((3, 3)))
    which = np.flatnonzero(alone)
    place = pixels_of_directions(towards[which], HEIGHT, WIDTH, z_up)
    count, num_valid, num_clipped, num_dark = (
        np.bincount(place, weights, HEIGHT * WIDTH)
        for weights in (None, *(kind.ravel()[which] for kind in kinds))
    )
    brought = np.nan_to_num(shown.reshape(-1, 3)[which])
    sums = [np.bincount(place, brought[:, c], HEIGHT * WIDTH) for c in range(3)]
    mean = (np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]).astype(np.float32)
    whole = np.flatnonzero((count > 0) & (num_valid == count))
    dark = np.flatnonzero((num_dark > 0) & (num_valid + num_dark == count))
    return _SeenInFrame(
        direction=whole.astype(np.int32),
        radiance=mean[whole],
        clipped=np.flatnonzero((count > 0) & (num_clipped == count)),
        dark=dark,
        darkness=mean[dark],
    )
