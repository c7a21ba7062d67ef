"""Incident light around each fitted pixel, traced once and reused for every roughness.

Directions come from a mixture: GGX lobes of five widths about the mirror direction, points on the
lights, and the cosine lobe; all combined by the balance heuristic over the whole mixture. So the
same samples integrate a mirror and a matte lobe, and the grid search is arithmetic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.rays import RayScene, lift_from_surface
from usdbrdf.geometry.surface_radiance import SurfaceTexture
from usdbrdf.material.lit_scene import LitScene
from usdbrdf.material.lobe_kernels import SampleArrays, draw_directions, integrate, weigh
from usdbrdf.material.target_frames import SurfacePoints
from usdbrdf.shading.environment import Environment
from usdbrdf.shading.lights import Lights
from usdbrdf.shading.warps import sobol_bits

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Long = npt.NDArray[np.int64]
Basis = Callable[[Sequence[float]], tuple[Float, Float]]

LOBE_ALPHAS = np.array([0.002, 0.01, 0.05, 0.15, 0.4])
_LANES = 8


@dataclass(frozen=True, kw_only=True)
class LobeSamples:
    """K samples at each of R surface points.

    cos_in     (R, K) float32, n.w (0 where the sample brings nothing)
    sin2_half  (R, K) float32, sin^2 of the angle between n and h
    grazing    (R, K) float32, (1 - w.h)^5
    weighted   (R, K, 3) float32, L cos / (K density of the whole mixture)
    cos_out    (R,) float32, n.wo
    """

    cos_in: Float
    sin2_half: Float
    grazing: Float
    weighted: Float
    cos_out: Float

    @property
    def arrays(self) -> SampleArrays:
        """What the kernels take, besides ``weighted``."""
        return self.cos_in, self.sin2_half, self.grazing, self.cos_out


@dataclass(frozen=True, kw_only=True)
class Mixture:
    """How many of a point's samples each technique draws: per lobe width, towards the lights, and
    cosine-distributed."""

    per_lobe: int = 8
    lights: int = 8
    cosine: int = 4


def trace_lobe_samples(
    rays: RayScene,
    points: SurfacePoints,
    radiance: SurfaceTexture,
    lights: Lights,
    environment: Environment,
    mixture: Mixture,
    scene_size: float,
    seed: int,
    stream: Long | None = None,
    alphas: Double | None = None,
    group: int = 1,
) -> LobeSamples:
    """Trace the mixture at R surface points; all of ``points`` must lie on the surface.

    group          this many consecutive points divide each technique's Sobol points among them, so
                   that their mean has a smaller error
    stream (G,)    groups of the same number share their random numbers; default: none do
    alphas (R, A)  the lobes' widths; default: LOBE_ALPHAS at every point, for any roughness
    """
    if not len(lights.face):
        mixture = Mixture(
            per_lobe=mixture.per_lobe, lights=0, cosine=mixture.cosine + mixture.lights
        )
    count = len(points.face)
    if alphas is None:
        alphas = np.broadcast_to(LOBE_ALPHAS, (count, len(LOBE_ALPHAS)))
    total = mixture.per_lobe * alphas.shape[1] + mixture.lights + mixture.cosine
    origin = lift_from_surface(points.position, points.normal, scene_size)
    counts = mixture.per_lobe, mixture.lights
    sobol = sobol_bits(int(np.ceil(np.log2(group * max(*counts, mixture.cosine)))))
    numbers = np.arange(count // group) if stream is None else stream
    directions = np.zeros((count * total, 3), np.float32)
    chosen = np.full((count, total), -1, np.int32)
    draw_directions(
        points.normal, points.to_camera, origin, (sobol, numbers, seed), counts, alphas,
        lights.groups.arrays, directions.reshape(count, total, 3), chosen,
    )  # fmt: skip
    hits = rays.closest(np.repeat(origin, total, axis=0), directions)
    samples = LobeSamples(
        cos_in=np.zeros((count, total), np.float32),
        sin2_half=np.zeros((count, total), np.float32),
        grazing=np.zeros((count, total), np.float32),
        weighted=radiance.at(hits.face, hits.u, hits.v).reshape(count, total, 3),
        cos_out=np.einsum("rd,rd->r", points.normal, points.to_camera),
    )
    weigh(
        points.normal, points.to_camera, directions.reshape(count, total, 3), chosen,
        (hits.face.reshape(count, total), hits.distance.reshape(count, total)), counts,
        alphas, lights.groups.arrays, environment.arrays, samples.weighted, samples.arrays,
    )  # fmt: skip
    return samples


def lobe_basis(
    lit: LitScene,
    points: SurfacePoints,
    num_groups: int,
    seed: int,
    mixture: Mixture = Mixture(),
    stream: Long | None = None,
) -> Basis:
    """Roughnesses (Q,) -> (base, slope) of I_nd = base + psi * slope, (num_groups, 3, Q) each: the
    mean over equally many consecutive ``points`` per group. Rays are traced once, when they
    are first needed."""

    @cache
    def samples() -> LobeSamples:
        return trace_lobe_samples(
            lit.rays, points, lit.radiance, lit.lights, lit.environment, mixture, lit.size, seed,
            stream, group=len(points.face) // max(num_groups, 1),
        )  # fmt: skip

    def basis(phis: Sequence[float]) -> tuple[Float, Float]:
        # As many as vector instructions take at once.
        padded = np.zeros(-(-len(phis) // _LANES) * _LANES, np.float32)
        padded[: len(phis)] = phis
        base, slope = non_diffuse(samples(), np.tile(padded, (num_groups, 1)))
        return base[..., : len(phis)], slope[..., : len(phis)]

    return basis


def non_diffuse(samples: LobeSamples, phis: Float) -> tuple[Float, Float]:
    """I_nd = base + psi * slope, (G, 3, Q) float32 each, means over each of G groups of consecutive
    points, for its roughnesses phis (G, Q)."""
    base = np.zeros((len(phis), 3, phis.shape[1]), np.float32)
    slope = np.zeros_like(base)
    integrate(samples.arrays, samples.weighted, phis, base, slope)
    return base, slope
