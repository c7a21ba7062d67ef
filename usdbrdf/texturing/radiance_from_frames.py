"""All frames into the running statistics of every texel."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.scene import Scene
from usdbrdf.geometry.texels import Texels
from usdbrdf.scan.frame_reading import read_frame
from usdbrdf.scan.scan import Frames
from usdbrdf.texturing import psquare
from usdbrdf.texturing.psquare import QuantileState
from usdbrdf.texturing.samples_from_frame import (
    CLIPPED,
    SAMPLE,
    first_surfaces,
    samples_from_frame,
)

Float = npt.NDArray[np.float32]
Int = npt.NDArray[np.int32]
# (frame, texels) -> what to take off their radiance, (len(texels), 3).
Specular = Callable[[int, Int], Float]


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
    specular: Specular | None = None,
) -> Iterator[int]:
    """Add frames start.. to ``observed``, in order; yields each frame's index once it is in.

    specular  the light that a frame's samples hold besides the diffuse

    The next frame is read and decoded while this one is projected.
    """
    owner = texels.object_index()
    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(read_frame, frames, start) if start < len(frames) else None
        for i in range(start, len(frames)):
            assert coming is not None
            pixels = coming.result()
            if i + 1 < len(frames):
                coming = reader.submit(read_frame, frames, i + 1)
            pose, lens = frames.world_from_camera[i], frames.intrinsics[i]
            surfaces = first_surfaces(rays, scene.face_object, pose, lens, frames.resolution[i])
            kind, radiance = samples_from_frame(
                texels, owner, surfaces, np.nan_to_num(pixels.radiance), pixels.valid,
                pixels.clipped, pose, lens,
            )  # fmt: skip
            sampled = np.flatnonzero(kind == SAMPLE).astype(np.int32)
            values = radiance[sampled]
            if specular is not None:
                values = values - specular(i, sampled)
            psquare.update(observed.quantiles, sampled, values, quantile)
            saturated = kind == CLIPPED
            observed.clipped[saturated] += 1
            limit = np.float32(frames.saturation_radiance[i])
            observed.lower_bound[saturated] = np.maximum(observed.lower_bound[saturated], limit)
            yield i
