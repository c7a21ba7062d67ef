"""All frames into the running statistics of every texel.

Bounds around tiles of texels let a frame pass over most of those that it cannot see."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf.ahead import ahead
from usdbrdf.files.frames import Read
from usdbrdf.geometry.unwrap import MAX_SIDE
from usdbrdf.kernel import parallel_kernel
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import Texels
from usdbrdf.texturing import psquare
from usdbrdf.texturing.exposures import Probes
from usdbrdf.texturing.psquare import QuantileState
from usdbrdf.texturing.samples import (
    CLIPPED,
    DARK,
    GLIMPSE,
    MIN_COSINE,
    SAMPLE,
    Picture,
    first_surfaces,
    samples_from_frame,
)
from usdbrdf.transport.lit_scene import TexturedScene

# Texels to a side of a tile.
_SIDE = 8


class TexelBlocks(NamedTuple):
    """B tiles of texels, or parts of such, and what bounds their points and normals.

    order   (T,) int32, texels; block b holds order[first[b]:first[b + 1]], first (B + 1,) int64
    centre  (B, 3) float32, radius (B,) float32: a sphere around their points
    axis    (B, 3) float32, spread (B,) float32: all normals lie within ``spread`` radians of it
    """

    order: Int
    first: Long
    centre: Float
    radius: Float
    axis: Float
    spread: Float

    def texels_in_view(self, camera: Camera, min_cosine: float) -> Int:
        """All texels, by block, that lie before the camera, project into the image and
        face the eye at ``min_cosine`` or more, and of few others."""
        width, height = camera.width, camera.height
        fx, fy, cx, cy = camera.intrinsics
        # Inward normals, in camera axes, of the planes through the image's borders and the eye.
        planes = np.array([
            [fx, 0, -cx], [-fx, 0, cx - width], [0, -fy, -cy], [0, fy, cy - height], [0, 0, -1],
        ])  # fmt: skip
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        normals = np.ascontiguousarray(planes @ camera.world_from_camera[:3, :3].T)
        eye = np.array(camera.eye, np.float64)
        in_view = np.zeros(len(self.centre), np.bool_)
        _in_view(len(in_view), self, normals, eye, float(np.arccos(min_cosine)), in_view)
        seen = np.flatnonzero(in_view)
        count = self.first[seen + 1] - self.first[seen]
        ends = np.cumsum(count)
        shift = np.repeat(self.first[seen] - (ends - count), count)
        which: Int = self.order[np.arange(len(shift)) + shift]
        return which


def blocks_of_texels(texels: Texels, part: slice) -> TexelBlocks:
    """Blocks of the texels of ``part``, each of one object and, as far as _SIDE allows, one side of
    a chart: tiles of the atlas, split by the axis along which the normal is longest."""
    owner = texels.object_index()[part]
    local = texels.pixel[part] - texels.first_pixel[owner]
    width = texels.resolution[owner, 0]
    tile = (local // width // _SIDE) * (MAX_SIDE // _SIDE) + local % width // _SIDE
    key = (owner.astype(np.int64) * (MAX_SIDE // _SIDE) ** 2 + tile) * 6
    # 0 to 5: x, y, z and their opposites.
    normal = texels.geometric_normal[part]
    axis = np.abs(normal).argmax(axis=1)
    key += axis + 3 * (np.take_along_axis(normal, axis[:, None], axis=1)[:, 0] < 0)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    order = (order + part.start).astype(np.int32)
    centre, axis = np.zeros((2, len(first), 3), np.float32)
    radius, spread = np.zeros((2, len(first)), np.float32)
    blocks = TexelBlocks(order, np.append(first, len(order)), centre, radius, axis, spread)
    _bound(len(first), texels.position, texels.geometric_normal, *blocks)
    return blocks


@parallel_kernel
def _bound(
    start: int, stop: int, position: Float, normal: Float, order: Int, first: Long, centre: Float,
    radius: Float, axis: Float, spread: Float,
) -> None:  # fmt: skip
    for b in range(start, stop):
        low, high = position[order[first[b]]].copy(), position[order[first[b]]].copy()
        total = np.zeros(3)
        for t in order[first[b] : first[b + 1]]:
            for k in range(3):
                low[k] = min(low[k], position[t, k])
                high[k] = max(high[k], position[t, k])
                total[k] += normal[t, k]
        length = np.sqrt((total**2).sum())
        away, least = 0.0, 1.0
        for k in range(3):
            centre[b, k] = (low[k] + high[k]) / 2
            axis[b, k] = total[k] / length if length > 0 else 0.0
        for t in order[first[b] : first[b + 1]]:
            squared, cosine = 0.0, 0.0
            for k in range(3):
                squared += (np.float64(position[t, k]) - centre[b, k]) ** 2
                cosine += np.float64(normal[t, k]) * axis[b, k]
            away, least = max(away, squared), min(least, cosine)
        # Rounded outwards: single precision, in which the bounds are kept, has seven digits.
        radius[b] = 1.00001 * np.sqrt(away) + 1e-6 * (np.abs(centre[b]).max() + 1e-3)
        spread[b] = np.arccos(max(least, -1.0)) + 2e-3


@parallel_kernel
def _in_view(
    start: int,
    stop: int,
    blocks: TexelBlocks,
    planes: Double,
    eye: Double,
    widest: float,
    seen: Bool,
) -> None:
    _, _, centre, radius, axis, spread = blocks
    for b in range(start, stop):
        x = eye[0] - centre[b, 0]
        y = eye[1] - centre[b, 1]
        z = eye[2] - centre[b, 2]
        inside = True
        for k in range(len(planes)):
            inside = inside and (
                planes[k, 0] * x + planes[k, 1] * y + planes[k, 2] * z <= radius[b]
            )
        if not inside:
            continue
        distance = np.sqrt(x * x + y * y + z * z)
        if distance <= radius[b]:
            seen[b] = True
            continue
        # The eye, seen from any point of the sphere, and any of the normals.
        cosine = (axis[b, 0] * x + axis[b, 1] * y + axis[b, 2] * z) / distance
        least = np.arccos(min(max(cosine, -1.0), 1.0)) - spread[b]
        seen[b] = least - np.arcsin(radius[b] / distance) <= widest


_GOLDEN = (math.sqrt(5) - 1) / 2
# Sides of a texel from its middle to any place of it, at most; charts stretch.
_BESIDE_MIDDLE = 2.0


class FrameSamples(NamedTuple):
    """What one frame shows: texels with a sample (M,) int32 and their radiance (M, 3) float32;
    texels that it saw saturated, clipped (K,) int32, and the radiance that saturates it; texels
    that were too dark for it, dark (D,) int32, their radiance with the noise (D, 3) float32, and
    the radiance of its noise floor; texels that it shows together with something else, glimpsed
    (G,) int32, and the radiance of their pixels (G, 3) float32."""

    frame: int
    texel: Int
    radiance: Float
    clipped: Int
    saturation: float
    dark: Int
    darkness: Float
    noise_floor: float
    glimpsed: Int
    glimpse: Float


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What all frames say of T texels: radiance in W/(m^2 sr), NaN where no frame measured it.

    median       (T, 3) float32, the quantile that was asked for
    mean         (T, 3) float32, 0 where no frame shows it
    spread       (T, 3) float32, see ``psquare.spread``
    count        (T,) int32, samples, or where there are none, frames that show how dark it is
    clipped      (T,) int32, frames in which the texel was visible but saturated
    lower_bound  (T,) float32, the largest radiance at which it still saturated
    glimpsed     (T,) bool: median and mean are of pixels that may show more than it; no frame
                 measured it
    probes       (P, N) float32, some texels' samples in each frame, see ``Probes``
    """

    median: Float
    mean: Float
    spread: Float
    count: Int
    clipped: Int
    lower_bound: Float
    glimpsed: Bool
    probes: Float


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the frames so far say of the texels from number ``first`` on, updated in place.

    quantiles    of the valid samples; where ``glimpsed`` (T,), there were none so far, of the
                 pixels that show the texel at their centre
    clipped, lower_bound, probes  as in ``Measured``
    dark         (T,) int32, frames in which the texel was visible but too dark
    darkness     (T, 3) float32, its mean radiance in these, each weighted by the inverse of its
                 noise floor's square; weight (T,) float64, the sum of the weights
    """

    first: int
    quantiles: QuantileState
    glimpsed: Bool
    clipped: Int
    lower_bound: Float
    dark: Int
    darkness: Float
    weight: Double
    probes: Probes

    @classmethod
    def empty(cls, part: slice, probes: Probes) -> Observation:
        """Of the texels of ``part``, no frame."""
        count = part.stop - part.start
        return cls(
            first=part.start,
            quantiles=QuantileState.empty(count),
            glimpsed=np.zeros(count, np.bool_),
            clipped=np.zeros(count, np.int32),
            lower_bound=np.zeros(count, np.float32),
            dark=np.zeros(count, np.int32),
            darkness=np.zeros((count, 3), np.float32),
            weight=np.zeros(count, np.float64),
            probes=probes,
        )

    def add(self, seen: FrameSamples, quantile: float) -> None:
        """One frame more."""
        sampled = seen.texel - np.int32(self.first)
        # A sample is worth more than all glimpses before it, and after one none is asked for.
        psquare.clear(self.quantiles, sampled[self.glimpsed[sampled]])
        self.glimpsed[sampled] = False
        psquare.update(self.quantiles, sampled, seen.radiance, quantile)
        glimpsed = seen.glimpsed - np.int32(self.first)
        new = self.glimpsed[glimpsed] | (self.quantiles.samples[glimpsed] == 0)
        self.glimpsed[glimpsed[new]] = True
        psquare.update(self.quantiles, glimpsed[new], seen.glimpse[new], quantile)
        saturated = seen.clipped - np.int32(self.first)
        self.clipped[saturated] += 1
        limit = np.float32(seen.saturation)
        self.lower_bound[saturated] = np.maximum(self.lower_bound[saturated], limit)
        dark = seen.dark - np.int32(self.first)
        if len(dark):
            own = seen.noise_floor**-2.0
            self.dark[dark] += 1
            self.weight[dark] += own
            share = (own / self.weight[dark, None]).astype(np.float32)
            self.darkness[dark] += share * (seen.darkness - self.darkness[dark])
        self.probes.add(seen.frame, seen.texel, seen.radiance)

    def of(self, part: slice) -> Observation:
        """The same of the texels of ``part``, which are among these."""
        own = slice(part.start - self.first, part.stop - self.first)
        return Observation(
            first=part.start,
            quantiles=QuantileState._make(values[own] for values in self.quantiles),
            glimpsed=self.glimpsed[own],
            clipped=self.clipped[own],
            lower_bound=self.lower_bound[own],
            dark=self.dark[own],
            darkness=self.darkness[own],
            weight=self.weight[own],
            probes=self.probes.of(part),
        )

    def arrays(self) -> dict[str, Array]:
        """All of its state."""
        return {
            **self.quantiles._asdict(),
            "glimpsed": self.glimpsed,
            "clipped": self.clipped,
            "lower_bound": self.lower_bound,
            "dark": self.dark,
            "darkness": self.darkness,
            "weight": self.weight,
            "probes": self.probes.logarithm,
        }

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """The state that ``arrays`` once returned."""
        for name, values in self.arrays().items():
            values[...] = arrays[name]

    def restore_earlier(self, arrays: Mapping[str, Array]) -> bool:
        """The same of a state of fewer frames, which were the first; False where its probes are of
        other texels, as those of very many frames are."""
        own, given = self.probes.logarithm, arrays["probes"]
        if len(own) != len(given):
            return False
        own[:, : given.shape[1]] = given
        self.restore({**arrays, "probes": own})
        return True

    def measured(self, quantile: float) -> dict[str, Array]:
        """The arrays of ``Measured``. What is dark in all frames is what they show, without its
        noise as far as they are many; in those that were exposed longer it is known better."""
        samples = np.where(self.glimpsed, 0, self.quantiles.samples)
        dark = (samples == 0) & (self.dark > 0)
        spread = psquare.spread(self.quantiles, quantile)
        values = psquare.quantile(self.quantiles, quantile), self.quantiles.mean
        median, mean = (np.where(dark[:, None], self.darkness, value) for value in values)
        return {
            "median": median,
            "mean": mean,
            "spread": np.where(self.glimpsed[:, None], np.float32(np.nan), spread),
            "count": np.where(dark, self.dark, samples),
            "clipped": self.clipped,
            "lower_bound": self.lower_bound,
            "glimpsed": self.glimpsed & ~dark,
            "probes": self.probes.logarithm,
        }


def samples_from_frames(
    surface: TexturedScene,
    frames: Frames,
    read: Read,
    order: Sequence[int],
    part: slice | None = None,
) -> Iterator[FrameSamples]:
    """What the frames of ``order`` show of the texels of ``part`` (None: all), one by one; that of
    the next ones is found while one is used. Frames before which none of them lie are not read."""
    texels = surface.texels
    owner = texels.object_index()
    blocks = blocks_of_texels(texels, part or slice(0, len(texels)))

    def samples(i: int) -> FrameSamples:
        camera = frames.camera(i)
        which = blocks.texels_in_view(camera, MIN_COSINE)
        if not len(which):
            return _nothing(i)
        pixels = read(i)
        surfaces = first_surfaces(surface.rays, surface.scene.face_object, camera)
        picture = Picture.of(pixels)
        kind, radiance = samples_from_frame(
            texels, owner, surfaces, picture, camera, which=which, glimpses=True
        )
        sampled, dark, glimpsed = kind == SAMPLE, kind == DARK, kind == GLIMPSE
        return FrameSamples(
            frame=i,
            texel=which[sampled],
            radiance=radiance[sampled],
            clipped=which[kind == CLIPPED],
            saturation=float(frames.saturation_radiance[i]),
            dark=which[dark],
            darkness=radiance[dark],
            noise_floor=float(frames.noise_floor_radiance[i]),
            glimpsed=which[glimpsed],
            glimpse=radiance[glimpsed],
        )

    return ahead(samples, order)


def _nothing(frame: int) -> FrameSamples:
    none, colours = np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    return FrameSamples(frame, none, colours, none, 1.0, none, colours, 1.0, none, colours)


def frames_in_view(texels: Texels, part: slice, frames: Frames, own: Sequence[int]) -> list[int]:
    """Which of the frames ``own`` may have pixels on the texels of ``part``: no others do."""
    blocks = blocks_of_texels(texels, part)
    # A pixel shows a texel at any place of it, not its middle alone.
    side = np.sqrt(texels.area[blocks.order])
    reach = _BESIDE_MIDDLE * np.maximum.reduceat(side, blocks.first[:-1])
    blocks = blocks._replace(radius=(blocks.radius + reach).astype(np.float32))
    return [i for i in own if len(blocks.texels_in_view(frames.camera(i), MIN_COSINE))]


def spread_order(count: int) -> list[int]:
    """The numbers below ``count``, so that what follows each other lies far apart: neighbours of a
    film show the same highlights."""
    step = max(1, round(_GOLDEN * count))
    while math.gcd(step, count) > 1:
        step += 1
    return [step * k % count for k in range(count)]
