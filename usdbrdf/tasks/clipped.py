"""Inside step 3: lamps that clip in every frame get the radiance that explains their light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from usdbrdf.job.progress import say
from usdbrdf.job.task import StageRun
from usdbrdf.model.arrays import Bool, Float, Int, Long
from usdbrdf.shading.clipped_emitters import (
    LAMP_PRIOR,
    EstimatedRadiance,
    estimate_clipped_emitters,
    nothing_known,
)
from usdbrdf.shading.clipped_groups import ClippedGroups, clipped_groups
from usdbrdf.shading.lamp_evidence import Evidence
from usdbrdf.tasks.atlas import Atlas
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.irradiance import Irradiance, Sampling, irradiance_at
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import surface_texture
from usdbrdf.transport.tile_draws import independent_tiles

# Texels that are asked, in all, and at least and at most on one facing of one object (a segment);
# and how many segments, those that the lamps should light most.
_TEXELS, _LEAST_OF_SEGMENT, _PER_SEGMENT, _SEGMENTS = 3000, 30, 150, 400

_SAMPLING = Sampling(standard_error=0.01, max_rays=1024)

# A bright wall that clips is little brighter than its bound.
_WALL_PRIOR = (0.3, 0.4)


@dataclass(frozen=True, kw_only=True)
class ClippedLight:
    """L_d with the estimates in it, and what they are.

    lit       (T, 3) float32: the working copy; the texturing step's map stays a lower bound
    groups    the K groups of clipped texels; estimate: their multipliers and errors
    """

    lit: Float
    groups: ClippedGroups
    estimate: EstimatedRadiance

    def may_shine(self, clipped: Bool) -> Bool:
        """(T,): the clipped texels but those that are clearly part of a bright wall."""
        wall = np.concatenate([~self.groups.lamp, [False]])
        return np.asarray(clipped & ~wall[self.groups.group], np.bool_)

    def error_of_object(self, index: int) -> float:
        """Relative standard error of the object's estimate; NaN if it has none."""
        own = (self.groups.object == index) & self.groups.lamp
        if not own.any() or not self.estimate.determined[own].all():
            return float("nan")
        return float(self.estimate.standard_error[own].max())

    def least_of_lamps(self) -> float:
        """Radiance of the dimmest lamp that stayed a lower bound; 0 if none did."""
        unknown = self.groups.bound[self.groups.lamp & ~self.estimate.determined]
        return float(unknown.min()) if len(unknown) else 0.0


def estimate_clipped_light(
    run: StageRun,
    atlas: Atlas,
    rays: RayScene,
    lit: Float,
    seen: Bool,
    clipped: Bool,
    environment: Environment,
    seed: int,
) -> ClippedLight:
    """The light ``lit`` (T, 3) as it is where no lamp clipped, else with the lamps' estimates.

    seen, clipped (T,): measured by some frame; seen, but clipped wherever it was.
    """
    groups = clipped_groups(atlas.texels, lit, seen, clipped)
    if not groups.lamp.any():
        return ClippedLight(lit=lit, groups=groups, estimate=nothing_known(len(groups)))
    say(f"shade: {len(groups)} parts clip in every frame; their light is weighed")

    def compute() -> dict[str, npt.NDArray[np.generic]]:
        chosen, segment = _chosen(atlas, groups, seen, seed)
        if not len(chosen):
            return dict(vars(nothing_known(len(groups))))
        evidence = _evidence(atlas, rays, lit, groups, chosen, segment, environment, seed)
        return dict(vars(estimate_clipped_emitters(evidence)))

    estimate = EstimatedRadiance(**run.checkpoint("clipped", compute))
    return ClippedLight(
        lit=_with_estimates(lit, groups, estimate), groups=groups, estimate=estimate
    )


def _with_estimates(lit: Float, groups: ClippedGroups, estimate: EstimatedRadiance) -> Float:
    changed = lit.copy()
    for k in np.flatnonzero(estimate.determined):
        changed[groups.group == k] = groups.bound[k] * estimate.multiplier[k]
    return changed


def _chosen(atlas: Atlas, groups: ClippedGroups, seen: Bool, seed: int) -> tuple[Long, Int]:
    """Measured texels spread over all objects, denser near the lamps, and their segments."""
    texels = atlas.texels
    usable = np.flatnonzero(seen & texels.interior & (groups.group < 0))
    owner = texels.object_index()[usable]
    normal = texels.normal[usable]
    axis = np.abs(normal).argmax(axis=1)
    facing = 2 * axis + (normal[np.arange(len(normal)), axis] > 0)
    segment = (6 * owner + facing).astype(np.int32)
    nearness = np.full(len(usable), 1e-6)
    for k in np.flatnonzero(groups.lamp):
        own = groups.group == k
        centre = np.average(texels.position[own], axis=0, weights=texels.area[own] + 1e-12)
        square = ((texels.position[usable] - centre) ** 2).sum(axis=1)
        nearness += texels.area[own].sum() / (square + texels.area[own].sum())
    weight = texels.area[usable] * np.sqrt(nearness)
    random = np.random.default_rng(seed)
    # Weighted sampling without replacement: the largest of u^(1/w), by logarithms.
    rank = np.argsort(np.log(random.random(len(usable))) / np.maximum(weight, 1e-30))[::-1]
    lit_by_lamps = np.bincount(segment, weight)
    numbers = np.argsort(-lit_by_lamps, kind="stable")[:_SEGMENTS]
    numbers = numbers[lit_by_lamps[numbers] > 0]
    each = int(np.clip(_TEXELS // max(len(numbers), 1), _LEAST_OF_SEGMENT, _PER_SEGMENT))
    rank = rank[np.isin(segment[rank], numbers)]
    rank = rank[np.argsort(segment[rank], kind="stable")]
    place = np.arange(len(rank)) - np.searchsorted(segment[rank], segment[rank])
    kept = np.sort(rank[place < each])
    return usable[kept], segment[kept]


def _evidence(
    atlas: Atlas,
    rays: RayScene,
    lit: Float,
    groups: ClippedGroups,
    chosen: Long,
    segment: Int,
    environment: Environment,
    seed: int,
) -> Evidence:
    dark = np.where(groups.group[:, None] >= 0, np.float32(0), lit)
    outside = black_environment()
    lamps = []
    for k in range(len(groups)):
        alone = np.where((groups.group == k)[:, None], groups.bound[k], np.float32(0))
        light = np.repeat(alone, 3, axis=1).astype(np.float32)
        lamps.append(_traced(atlas, rays, light, outside, chosen, seed + k + 1).mean)
    return Evidence(
        radiance=lit[chosen],
        irradiance=_traced(atlas, rays, dark, environment, chosen, seed).mean,
        lamp_irradiance=np.stack(lamps),
        position=atlas.texels.position[chosen],
        segment=segment,
        object=atlas.texels.object_index()[chosen].astype(np.int32),
        prior=np.array([LAMP_PRIOR if lamp else _WALL_PRIOR for lamp in groups.lamp]),
    )


def _traced(
    atlas: Atlas, rays: RayScene, light: Float, environment: Environment, chosen: Long, seed: int
) -> Irradiance:
    scene, texels = atlas.scene, atlas.texels
    return irradiance_at(
        rays,
        surface_texture(texels, scene.face_object, light),
        lights_from_radiance(scene, texels, light),
        environment,
        texels.position[chosen],
        texels.normal[chosen],
        independent_tiles(len(chosen)),
        Sampling(standard_error=_SAMPLING.standard_error, max_rays=_SAMPLING.max_rays, seed=seed),
        float(np.linalg.norm(np.ptp(scene.points, axis=0))),
    )
