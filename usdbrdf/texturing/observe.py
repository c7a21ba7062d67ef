"""All frames into the running statistics of every texel."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.model.arrays import Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.scene import Scene
from usdbrdf.model.texels import Texels
from usdbrdf.texturing import psquare
from usdbrdf.texturing.psquare import QuantileState
from usdbrdf.texturing.samples import CLIPPED, MIN_COSINE, SAMPLE, first_surfaces, samples_of_texels
from usdbrdf.texturing.texel_blocks import blocks_of_texels
from usdbrdf.transport.rays import RayScene

# Threads that decode, and frames in memory besides the one that is projected.
_READERS, _AHEAD = 2, 3

_GOLDEN = (math.sqrt(5) - 1) / 2


@dataclass(frozen=True, kw_only=True)
class FrameSamples:
    """What one frame shows: texels with a sample (M,) int32 and their radiance (M, 3) float32;
    texels that it saw saturated, clipped (K,) int32."""

    frame: int
    texel: Int
    radiance: Float
    clipped: Int


@dataclass(frozen=True, kw_only=True)
class Observation:
    """What the frames so far say of T texels, updated in place.

    quantiles    of the valid samples
    clipped      (T,) int32, how often the texel was visible but saturated
    lower_bound  (T,) float32, the largest radiance at which it still saturated
    """

    quantiles: QuantileState
    clipped: Int
    lower_bound: Float

    @classmethod
    def empty(cls, num_texels: int) -> Observation:
        return cls(
            quantiles=QuantileState.empty(num_texels),
            clipped=np.zeros(num_texels, np.int32),
            lower_bound=np.zeros(num_texels, np.float32),
        )

    @classmethod
    def from_arrays(cls, arrays: dict[str, npt.NDArray[Any]]) -> Observation:
        names = ("heights", "positions", "count", "mean")
        return cls(
            quantiles=QuantileState(**{name: arrays[name] for name in names}),
            clipped=arrays["clipped"],
            lower_bound=arrays["lower_bound"],
        )

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {
            "heights": self.quantiles.heights,
            "positions": self.quantiles.positions,
            "count": self.quantiles.count,
            "mean": self.quantiles.mean,
            "clipped": self.clipped,
            "lower_bound": self.lower_bound,
        }


def radiance_from_frames(
    texels: Texels,
    scene: Scene,
    rays: RayScene,
    frames: Frames,
    observed: Observation,
    quantile: float,
    start: int = 0,
    part: slice | None = None,
) -> Iterator[int]:
    """Add frames start.. to ``observed``, in order; yields each frame's index once it is in.

    part  the texels that ``observed`` is of; None: all
    """
    first = np.int32(part.start if part else 0)
    for sampled in samples_from_frames(
        texels, scene, rays, frames, range(start, len(frames)), part
    ):
        psquare.update(observed.quantiles, sampled.texel - first, sampled.radiance, quantile)
        saturated = sampled.clipped - first
        observed.clipped[saturated] += 1
        limit = np.float32(frames.saturation_radiance[sampled.frame])
        observed.lower_bound[saturated] = np.maximum(observed.lower_bound[saturated], limit)
        yield sampled.frame


def samples_from_frames(
    texels: Texels,
    scene: Scene,
    rays: RayScene,
    frames: Frames,
    order: Sequence[int],
    part: slice | None = None,
) -> Iterator[FrameSamples]:
    """What the frames of ``order`` show of the texels of ``part`` (None: all), one by one.

    The next frames are read and decoded while one is projected.
    """
    owner = texels.object_index()
    blocks = blocks_of_texels(texels, part or slice(0, len(texels)))
    for i, pixels in zip(order, _read_ahead(frames, order), strict=True):
        camera = frames.camera(i)
        which = blocks.texels_in_view(camera, MIN_COSINE)
        kind, radiance = samples_of_texels(
            texels, which, owner, first_surfaces(rays, scene.face_object, camera),
            pixels.radiance, pixels.valid, pixels.clipped, camera,
        )  # fmt: skip
        yield FrameSamples(
            frame=i,
            texel=which[kind == SAMPLE],
            radiance=radiance[kind == SAMPLE],
            clipped=which[kind == CLIPPED],
        )


def spread_order(count: int) -> list[int]:
    """The numbers below ``count``, so that what follows each other lies far apart: neighbours of a
    film show the same highlights."""
    step = max(1, round(_GOLDEN * count))
    while math.gcd(step, count) > 1:
        step += 1
    return [step * k % count for k in range(count)]


def _read_ahead(frames: Frames, order: Sequence[int]) -> Iterator[FramePixels]:
    """The pixels of the frames of ``order``, some in memory before they are asked for."""
    with ThreadPoolExecutor(max_workers=_READERS) as readers:
        coming = deque(readers.submit(read_frame, frames, i) for i in order[:_AHEAD])
        try:
            for ahead in range(_AHEAD, len(order) + _AHEAD):
                pixels = coming.popleft().result()
                if ahead < len(order):
                    coming.append(readers.submit(read_frame, frames, order[ahead]))
                yield pixels
        finally:
            for job in coming:
                job.cancel()
