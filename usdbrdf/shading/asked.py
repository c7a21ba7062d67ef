"""Texels that are asked what lights a scan, and what they receive of the light that is known."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from usdbrdf.model.arrays import Float, Int, Long
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.options import Sampling
from usdbrdf.shading.outside_light import Asked
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.irradiance import independent_tiles, irradiance_at
from usdbrdf.transport.lights import Lights
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.rays import lift_from_surface
from usdbrdf.transport.sunlight import sunlight
from usdbrdf.transport.surface_texture import SurfaceTexture
from usdbrdf.transport.warps import cosine_rays

# Texels that are asked, at most and at least on one side of one object (a segment), and segments.
PER_SEGMENT, LEAST_OF_SEGMENT, _SEGMENTS = 240, 30, 80
_SEED = 0x51C4
# How closely it is known what these receive.
CLOSELY = Sampling(standard_error=0.01, max_rays=1024)


def asked_texels(
    texels: Texels, lit: Float, coverage: CoverageMap, seed: int, most: int = PER_SEGMENT
) -> Asked | None:
    """Texels of the largest segments that were measured, with some of them that clip, ``most`` of
    each, and no light yet; None where there are too few."""
    usable = np.flatnonzero(coverage.observed & texels.interior & (lit > 0).all(axis=1))
    segment = texels.segments(usable)
    measured = coverage.measured[usable]
    area = np.bincount(segment, texels.area[usable] * measured)
    enough = np.bincount(segment, measured) >= np.maximum(
        LEAST_OF_SEGMENT, np.bincount(segment) / 2
    )
    largest = np.argsort(-area * enough, kind="stable")[:_SEGMENTS]
    largest = largest[enough[largest]]
    if not len(largest):
        return None
    rank = np.random.default_rng(seed ^ _SEED).permutation(len(usable))
    kept = first_of_segments(rank, segment, largest, most)
    many = np.bincount(segment[kept], measured[kept])[segment[kept]] >= LEAST_OF_SEGMENT / 2
    kept = kept[many]
    if not len(kept):
        return None
    return Asked(
        texel=usable[kept],
        segment=np.unique(segment[kept], return_inverse=True)[1].astype(np.int32),
        owner=texels.object_index()[usable[kept]],
        reflected=np.pi * lit[usable[kept]].astype(np.float64),
        clipped=~measured[kept],
        irradiance=np.zeros((len(kept), 3)),
        mirrored=np.zeros((len(kept), 3)),
    )


def first_of_segments(rank: Long, segment: Int, numbers: Long, most: int) -> Long:
    """Of those in ``rank`` (R,), indices into ``segment`` (N,), the first of each of the segments
    ``numbers``, ``most`` at most; by segment."""
    rank = rank[np.isin(segment[rank], numbers)]
    rank = rank[np.argsort(segment[rank], kind="stable")]
    place = np.arange(len(rank)) - np.searchsorted(segment[rank], segment[rank])
    return rank[place < most]


class Shining(NamedTuple):
    """The radiance of all surfaces as rays meet it, and where that is bright."""

    texture: SurfaceTexture
    lights: Lights

    @classmethod
    def of(
        cls, surface: TexturedScene, light: Float, environment: Environment | None = None
    ) -> Shining:
        """light (T, 3), W/(m^2 sr); environment: what shines in from outside, if it counts."""
        return cls(surface.texture(light), surface.lights_of(light, environment))


def irradiance_of_texels(
    surface: TexturedScene,
    shining: Shining,
    outside: Environment,
    index: Long,
    seed: int,
    sampling: Sampling = CLOSELY,
) -> Float:
    """S (N, 3), W/m^2, of a few texels in the light of the surfaces and what is outside."""
    texels = surface.texels
    return sunlight(surface, index, outside.sun, seed) + irradiance_at(
        surface.light_rays, *shining, outside, texels.position[index], texels.normal[index],
        independent_tiles(len(index)), replace(sampling, seed=seed), surface.diagonal_m,
    ).mean  # fmt: skip


def looked_around(surface: TexturedScene, index: Long, seed: int, rays: int) -> tuple[Float, Int]:
    """Cosine-distributed directions (rays N, 3) from texels (N,), one of each after the other, and
    the face that each meets, -1 for none."""
    texels = surface.texels
    normal = texels.normal[index]
    origin = lift_from_surface(texels.position[index], normal, surface.diagonal_m)
    towards = cosine_rays(normal, index, seed, rays)
    return towards, surface.light_rays.closest(origin, towards).face
