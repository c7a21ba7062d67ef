"""All frames into the running statistics of every texel."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from usdbrdf.files.frames import FramePixels
from usdbrdf.model.arrays import Array, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.texturing import psquare
from usdbrdf.texturing.exposures import Probes
from usdbrdf.texturing.psquare import QuantileState
from usdbrdf.texturing.samples import (
    CLIPPED,
    MIN_COSINE,
    SAMPLE,
    Picture,
    first_surfaces,
    samples_from_frame,
)
from usdbrdf.texturing.texel_blocks import blocks_of_texels
from usdbrdf.transport.rays import RayScene

_GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, kw_only=True)
class FrameSamples:
    """What one frame shows: texels with a sample (M,) int32 and their radiance (M, 3) float32;
    texels that it saw saturated, clipped (K,) int32, and the radiance that saturates it."""

    frame: int
    texel: Int
    radiance: Float
    clipped: Int
    saturation: float


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What all frames say of T texels: radiance in W/(m^2 sr), NaN where no frame measured it.

    median       (T, 3) float32, the quantile that was asked for
    mean         (T, 3) float32, 0 where no frame measured it
    spread       (T, 3) float32, see ``psquare.spread``
    count        (T,) int32, samples
    clipped      (T,) int32, frames in which the texel was visible but saturated
    lower_bound  (T,) float32, the largest radiance at which it still saturated
    probes       (P, N) float32, some texels' samples in each frame, see ``Probes``
    """

    median: Float
    mean: Float
    spread: Float
    count: Int
    clipped: Int
    lower_bound: Float
    probes: Float


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the frames so far say of the texels from number ``first`` on, updated in place.

    quantiles    of the valid samples
    clipped, lower_bound, probes  as in ``Measured``
    """

    first: int
    quantiles: QuantileState
    clipped: Int
    lower_bound: Float
    probes: Probes

    @classmethod
    def empty(cls, part: slice, probes: Probes) -> Observation:
        """Of the texels of ``part``, no frame."""
        count = part.stop - part.start
        return cls(
            first=part.start,
            quantiles=QuantileState.empty(count),
            clipped=np.zeros(count, np.int32),
            lower_bound=np.zeros(count, np.float32),
            probes=probes,
        )

    def add(self, seen: FrameSamples, quantile: float) -> None:
        """One frame more."""
        psquare.update(self.quantiles, seen.texel - np.int32(self.first), seen.radiance, quantile)
        saturated = seen.clipped - np.int32(self.first)
        self.clipped[saturated] += 1
        limit = np.float32(seen.saturation)
        self.lower_bound[saturated] = np.maximum(self.lower_bound[saturated], limit)
        self.probes.add(seen.frame, seen.texel, seen.radiance)

    def arrays(self) -> dict[str, Array]:
        """All of its state."""
        return {
            **self.quantiles._asdict(),
            "clipped": self.clipped,
            "lower_bound": self.lower_bound,
            "probes": self.probes.logarithm,
        }

    def restore(self, arrays: Mapping[str, Array]) -> None:
        """The state that ``arrays`` once returned."""
        for name, values in self.arrays().items():
            values[...] = arrays[name]

    def measured(self, quantile: float) -> dict[str, Array]:
        """The arrays of ``Measured``."""
        return {
            "median": psquare.quantile(self.quantiles, quantile),
            "mean": self.quantiles.mean,
            "spread": psquare.spread(self.quantiles, quantile),
            "count": self.quantiles.samples,
            "clipped": self.clipped,
            "lower_bound": self.lower_bound,
            "probes": self.probes.logarithm,
        }


def samples_from_frames(
    texels: Texels,
    scene: Scene,
    rays: RayScene,
    frames: Frames,
    images: Iterable[tuple[int, FramePixels]],
    part: slice | None = None,
) -> Iterator[FrameSamples]:
    """What frames show of the texels of ``part`` (None: all), one by one.

    images  numbers and pixels of the frames, see ``read_frames``
    """
    owner = texels.object_index()
    blocks = blocks_of_texels(texels, part or slice(0, len(texels)))
    for i, pixels in images:
        camera = frames.camera(i)
        which = blocks.texels_in_view(camera, MIN_COSINE)
        surfaces = first_surfaces(rays, scene.face_object, camera)
        picture = Picture(pixels.radiance, pixels.valid, pixels.clipped)
        kind, radiance = samples_from_frame(texels, owner, surfaces, picture, camera, which=which)
        yield FrameSamples(
            frame=i,
            texel=which[kind == SAMPLE],
            radiance=radiance[kind == SAMPLE],
            clipped=which[kind == CLIPPED],
            saturation=float(frames.saturation_radiance[i]),
        )


def spread_order(count: int) -> list[int]:
    """The numbers below ``count``, so that what follows each other lies far apart: neighbours of a
    film show the same highlights."""
    step = max(1, round(_GOLDEN * count))
    while math.gcd(step, count) > 1:
        step += 1
    return [step * k % count for k in range(count)]
