"""Lamps that clip in every frame get the radiance that explains their light.

Clipped texels that hang together are one group, which looks like a lamp or like a bright wall; what
each of the groups sends to a few thousand measured texels is traced, and their radiances follow.
Texels of every kind tell whether a lamp is determined; how bright it is, those that lie evenly in
its light tell better (``lamp_light``).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from types import MappingProxyType

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.shading.asked import Shining, asked_texels, first_of_segments, irradiance_of_texels
from usdbrdf.shading.clipped_emitters import (
    LEAST_ERROR,
    MAX_ERROR,
    UNTOLD,
    EstimatedRadiance,
    Evidence,
    estimate_clipped_emitters,
    nothing_known,
)
from usdbrdf.shading.clipped_groups import ClippedGroups, clipped_groups, hardly_shown, with_unseen
from usdbrdf.shading.gloss import angles_of_glare, mirrored_to_frames
from usdbrdf.shading.hidden_light import KnownLamps, light_of_hidden, said_to_shine
from usdbrdf.shading.lamp_light import looked_at_closely
from usdbrdf.shading.outside_light import Asked, doubt_by_views
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.lit_scene import TexturedScene

_UNIT = np.float32(calibration.number("lamps.errors.unit"))
# Texels that are asked, in all, and at least and at most on one facing of one object (a segment);
# and how many segments, those that the lamps should light most.
_TEXELS, _LEAST_OF_SEGMENT, _PER_SEGMENT, _SEGMENTS = 3000, 30, 150, 400
# Lamps that are looked at closely, at most: those with the most light.
_CLOSELY = 8
# Texels of a part that are asked whether daylight explains them.
_ASKED = 128
_WIDER = calibration.number("lamps.wider_than_glints")
_LEAST_OF_LIGHT = calibration.number("lamps.least_of_light")
_SOME_EXPLAINED, _EXPLAINED = calibration.pair("lamps.explained_by_daylight")


def lamps_with_unseen(
    texels: Texels,
    coverage: CoverageMap,
    groups: ClippedGroups,
    estimate: EstimatedRadiance,
    brought: Callable[[Bool], float],
) -> tuple[ClippedGroups, EstimatedRadiance]:
    """The groups and what they are told to send, the lamps among them that are determined with what
    nobody saw beside them: one that is seen in part would otherwise be as much too bright as it is
    too small. What they bring stays, by what texels (T,) of one radiance ``brought``, and none
    falls below its bound for that."""
    group, multiplier = groups.group.copy(), estimate.multiplier.copy()
    for k in np.flatnonzero(groups.lamp & estimate.determined):
        own = np.arange(*texels.of_object(int(groups.object[k])).indices(len(texels)))
        part, free = np.flatnonzero(group == k), own[~coverage.observed[own] & (group[own] < 0)]
        larger = with_unseen(texels, part, own[coverage.observed[own]], free)
        if len(larger) == len(part):
            continue
        shines = group == k
        of_part = brought(shines)
        shines[larger] = True
        seen = of_part / max(brought(shines), 1e-30)
        if multiplier[k].max() * seen >= 1:
            group[larger], multiplier[k] = k, multiplier[k] * seen
    return replace(groups, group=group), replace(estimate, multiplier=multiplier)


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
        """(T,): the clipped texels, and what nobody saw of lamps that are determined, but those
        that are clearly part of a bright wall."""
        lamps = self.groups.texels_of(self.groups.lamp & self.estimate.determined)
        return np.asarray((clipped | lamps) & ~self.groups.wall, np.bool_)

    def error_of_object(self, index: int) -> float:
        """Relative standard error of the object's estimate; NaN if it has none."""
        own = (self.groups.object == index) & self.groups.lamp
        if not own.any() or not self.estimate.determined[own].all():
            return float("nan")
        return float(self.estimate.standard_error[own].max())

    def least_of_lamps(self, reflected: Float) -> float:
        """Radiance, in its largest channel, of the dimmest lamp that stayed a lower bound; 0 if
        none did. ``reflected`` (T,): the most that a reflector would show in any channel: what is
        bounded by no more than that may be one, as a sunlit patch is, and so may what is small."""
        group, count = self.groups.group, len(self.groups)
        own = group >= 0
        num_own = np.maximum(np.bincount(group[own], minlength=count), 1)
        level = np.bincount(group[own], reflected[own], count) / num_own
        lamp = self.groups.lamp & ~self.groups.small & ~self.estimate.determined
        lamp &= self.groups.bound > level
        return float(self.groups.bound[lamp].min()) if lamp.any() else 0.0


def estimate_clipped_light(
    run: TaskRun,
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    environment: Environment,
    seed: int,
    said: Mapping[int, bool] = MappingProxyType({}),
    unseen: Bool | None = None,
    differing: Callable[[], Double] | None = None,
) -> ClippedLight:
    """The light ``lit`` (T, 3) as it is where no lamp clipped, else with the lamps' estimates.
    said: of objects whether they are lamps, where that is known. unseen (T,): the texels of lamps
    that no frame shows, whose radiance is in ``lit``; None without any. differing: tells, as
    ``AssetMaps.differing``, how far views of one texel differ; None where that is not known."""
    spots = hardly_shown(surface.texels, coverage, said)
    if len(spots):
        given = surface, coverage, frames, spots, seed
        spots = run.checkpoint("spots", lambda: {"spot": without_glints(*given)})["spot"]
    groups = clipped_groups(surface.texels, lit, coverage, said, spots)
    if not groups.lamp.any():
        return ClippedLight(lit=lit, groups=groups, estimate=nothing_known(len(groups)))
    say(f"shade: {len(groups)} parts clip in every frame; their light is weighed")

    def compute() -> dict[str, Array]:
        given = surface, lit, coverage, frames, environment, groups, said, unseen, differing, seed
        told, wall = _Weighing(*given).told()
        return {**vars(told), "wall": wall}

    found = dict(run.checkpoint("clipped", compute))
    groups = groups.with_walls(found.pop("wall"))
    estimate = EstimatedRadiance(**found)
    # Hardly a scan has a lamp to ask them of.
    asked = cache(partial(_chosen, surface.texels, groups, coverage.measured, seed))

    def brought(shines: Bool) -> float:
        light = Shining.of(surface, np.repeat(shines[:, None], 3, axis=1).astype(np.float32))
        dark, (chosen, _) = black_environment(), asked()
        return float(irradiance_of_texels(surface, light, dark, chosen, seed).sum())

    groups, estimate = lamps_with_unseen(surface.texels, coverage, groups, estimate, brought)
    lit = _with_estimates(lit, groups, estimate)
    estimate = replace(estimate, standard_error=np.hypot(estimate.standard_error, UNTOLD))
    return ClippedLight(lit=lit, groups=groups, estimate=estimate)


def without_glints(
    surface: TexturedScene, coverage: CoverageMap, frames: Frames, spots: Long, seed: int
) -> Long:
    """Those of the objects ``spots`` that shine to all sides: of which a texel clips in frames from
    directions that are farther apart than those in which a mirror image of a lamp is seen."""
    owner = surface.texels.object_index()
    index = np.flatnonzero(np.isin(owner, spots) & coverage.clipped)
    apart = angles_of_glare(surface, frames, index, seed)
    return np.unique(owner[index[apart > _WIDER]]).astype(np.int64)


@dataclass(frozen=True)
class _Weighing:
    """The ``groups`` and all that tells of their light."""

    surface: TexturedScene
    lit: Float
    coverage: CoverageMap
    frames: Frames
    environment: Environment
    groups: ClippedGroups
    said: Mapping[int, bool]
    unseen: Bool | None
    differing: Callable[[], Double] | None
    seed: int

    @cached_property
    def _chosen(self) -> tuple[Long, Int]:
        """As of ``_chosen``."""
        return _chosen(self.surface.texels, self.groups, self.coverage.measured, self.seed)

    @cached_property
    def _doubt(self) -> Double:
        """(N,), of the texels chosen."""
        chosen, _ = self._chosen
        if self.differing is None:
            return np.ones(len(chosen))
        return doubt_by_views(self.differing()[self.surface.texels.object_index()[chosen]])

    @cached_property
    def _asked(self) -> Asked | None:
        """With their bounds, whatever light of the sun what clips is taken to reflect."""
        return asked_texels(self.surface.texels, self.lit, self.coverage, self.seed)

    @cached_property
    def _of_each(self) -> Float:
        """(K, N, 3) W/m^2: what each of the groups, at its bound, brings to the texels chosen."""
        groups, (chosen, _) = self.groups, self._chosen
        brought = np.zeros((len(groups), len(chosen), 3), np.float32)
        for k in np.unique(groups.group[groups.group >= 0]):
            alone = np.where((groups.group == k)[:, None], groups.bound[k], np.float32(0))
            light = Shining.of(self.surface, np.repeat(alone, 3, axis=1).astype(np.float32))
            dark, own_seed = black_environment(), self.seed + int(k) + 1
            brought[k] = irradiance_of_texels(self.surface, light, dark, chosen, own_seed)
        return brought

    def told(self) -> tuple[EstimatedRadiance, Bool]:
        """The estimate, and which of the groups (K,) reflect the light of others than these."""
        groups, wall = self.groups, np.zeros(len(self.groups), np.bool_)
        if not len(self._chosen[0]):
            return nothing_known(len(groups)), wall
        told, evenly = self._by(self.lit, groups)
        if self.unseen is not None or self.environment.sun.shines or self._is_day():
            wall = self._reflect_other_light(told, evenly)
        if wall.any():
            # What the sun shines on may be many times its bound, which lamps beside it would send.
            told = self._beside(self.lit, wall)
        walls = wall | (~groups.lamp & self._is_measured())
        if walls.any() and told.determined[~walls].any() and self._matter(walls):
            # So may what the lamps themselves shine on. Few texels may tell a lamp, and which of
            # them lie evenly in its light depends on how strong it is taken to be.
            before = told.of_lamps(~walls)
            told = self._beside(_with_estimates(self.lit, groups, before), walls).else_of(before)
        return told, wall

    def _is_measured(self) -> Bool:
        """Of which of the groups' objects (K,) frames tell the albedo."""
        owner = self.surface.texels.object_index()
        return np.isin(self.groups.object, owner[self.coverage.measured])

    def _by(self, light: Float, groups: ClippedGroups) -> tuple[EstimatedRadiance, Bool]:
        """As of ``_told_by_even_light``."""
        first = estimate_clipped_emitters(self._evidence(light, groups))
        given = light, self._asked, self.frames, self.environment, groups, first, self.seed
        return _told_by_even_light(self.surface, *given)

    def _evidence(self, light: Float, groups: ClippedGroups) -> Evidence:
        texels, (chosen, segment) = self.surface.texels, self._chosen
        rest = np.where(groups.group[:, None] >= 0, np.float32(0), light)
        shining = Shining.of(self.surface, rest, self.environment)
        # Of some groups no texel may be left.
        left = np.isin(np.arange(len(groups)), groups.group)
        return Evidence(
            radiance=light[chosen],
            irradiance=irradiance_of_texels(
                self.surface, shining, self.environment, chosen, self.seed
            ),
            lamp_irradiance=np.where(left[:, None, None], self._of_each, np.float32(0)),
            position=texels.position[chosen] / (_UNIT * np.sqrt(texels.area.sum())),
            segment=segment,
            object=texels.object_index()[chosen].astype(np.int32),
            doubt=self._doubt,
            prior=groups.priors(),
            shines=groups.lamp,
        )

    def _beside(self, light: Float, walls: Bool) -> EstimatedRadiance:
        """Where those of the groups (K,) send what they reflect of the ``light`` (T, 3)."""
        left, shines = self.groups.with_walls(walls), said_to_shine(self.surface.texels, self.said)
        shines |= left.texels_of(left.lamp) | (False if self.unseen is None else self.unseen)
        given = self.coverage, self.environment, self.seed, KnownLamps(shines, self.said)
        light = light_of_hidden(self.surface, light, *given)
        light = np.where(left.texels_of(walls)[:, None], light, self.lit)
        return self._by(light, left.without(walls))[0].of_lamps(~walls)

    def _reflect_other_light(self, told: EstimatedRadiance, evenly: Bool) -> Bool:
        groups = self.groups
        by_hand = np.array([self.said.get(int(i), -1) for i in groups.object])
        # Beside a window lamps as bright as need be take up what its light leaves unexplained:
        # where other light suffices, one must show itself in the light that it casts evenly.
        # What a person says is no lamp reflects, and may do so of that light alone.
        least = np.where(by_hand == 1, np.inf, np.where(evenly, told.least().max(axis=1), 1.0))
        weighed = replace(groups, lamp=groups.lamp | (by_hand == 0))
        given = self.coverage, self.frames, weighed, least, self.environment, self.seed
        return reflects_other_light(self.surface, self.lit, *given)

    def _is_day(self) -> bool:
        """Whether the sky lights the texels chosen, as one by night does not."""
        outside = self.environment
        return bool(outside.image.any()) and self._lights(np.zeros_like(self.lit), outside)

    def _matter(self, walls: Bool) -> bool:
        """Whether those of the groups (K,), at their bounds, light the texels chosen."""
        clips = self.groups.texels_of(walls)[:, None]
        return self._lights(np.where(clips, self.lit, np.float32(0)), black_environment())

    def _lights(self, light: Float, outside: Environment) -> bool:
        """Whether that alone is more than next to nothing of what the texels chosen reflect."""
        shining = Shining.of(self.surface, light, outside)
        chosen, _ = self._chosen
        received = irradiance_of_texels(self.surface, shining, outside, chosen, self.seed)
        reflected = np.pi * self.lit[chosen].mean()
        return bool(received.mean() > _LEAST_OF_LIGHT * reflected)


def reflects_other_light(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    groups: ClippedGroups,
    least: Double,
    environment: Environment,
    seed: int,
) -> Bool:
    """(K,): of the groups that look like lamps those that clip because of the light that falls on
    them, from outside or of lamps that no frame shows: by the albedo of what was measured of the
    object, and what a usual dielectric mirrors, some of their texels would be about as bright as
    they are at least, ``least`` (K,) times their bounds; of an object of which nothing was
    measured, if it were white, as bright as that. The light of all these groups is left out."""
    texels, lamps = surface.texels, np.flatnonzero(groups.lamp & np.isfinite(least))
    owner = texels.object_index()

    def some(which: Bool) -> Long:
        index = np.flatnonzero(which)
        return index[np.linspace(0, len(index) - 1, min(len(index), _ASKED)).astype(np.int64)]

    own = [some(coverage.clipped & (groups.group == k)) for k in lamps]
    others = [some(coverage.measured & (owner == groups.object[k])) for k in lamps]
    if not len(lamps):
        return np.zeros(len(groups), np.bool_)
    texel = np.concatenate([*own, *others])
    rest = np.where(groups.texels_of(groups.lamp)[:, None], np.float32(0), lit)
    shining = Shining.of(surface, rest, environment)
    reflected = irradiance_of_texels(surface, shining, environment, texel, seed) / np.pi
    clipped = np.concatenate(own)
    mirrored = mirrored_to_frames(surface, rest, environment, frames, clipped, seed)
    explained, at, beside = np.zeros(len(groups), np.bool_), 0, len(clipped)
    for k, one, other in zip(lamps, own, others, strict=True):
        near, far = np.s_[at : at + len(one)], np.s_[beside : beside + len(other)]
        at, beside = at + len(one), beside + len(other)
        albedo, share = np.ones(3), 1.0
        if len(other):
            share = _EXPLAINED
            albedo = np.median(lit[other] / np.maximum(reflected[far], 1e-30), axis=0)
        most = np.minimum(albedo, 1) * reflected[near] + mirrored[near]
        ratio = most.max(axis=1) / lit[one].max(axis=1)
        explained[k] = np.quantile(ratio, 1 - _SOME_EXPLAINED) > share * least[k]
    return explained


def _with_estimates(lit: Float, groups: ClippedGroups, estimate: EstimatedRadiance) -> Float:
    lit = lit.copy()
    least = estimate.least()
    brighter = groups.lamp & (least != 1).any(axis=1)
    for k in np.flatnonzero(estimate.determined | brighter):
        told = estimate.multiplier[k] if estimate.determined[k] else least[k]
        lit[groups.group == k] = groups.bound[k] * told
    return lit


def _told_by_even_light(
    surface: TexturedScene,
    lit: Float,
    asked: Asked | None,
    frames: Frames,
    environment: Environment,
    groups: ClippedGroups,
    first: EstimatedRadiance,
    seed: int,
) -> tuple[EstimatedRadiance, Bool]:
    """The estimate with those of its lamps looked at closely, all together, that are determined
    or exceed their bounds; where that says too little of a lamp, or that it is darker than its
    bound, the ``first`` one. And of which (K,) it said enough."""
    told = first.determined | (first.least() > 1).any(axis=1)
    lamps = np.flatnonzero(groups.lamp & told)[:_CLOSELY]
    evenly = np.zeros(len(groups), np.bool_)
    if not len(lamps) or asked is None:
        return first, evenly
    plain = groups.group[asked.texel] < 0
    # An object of which a part shines mirrors a lamp there, or glows: so may the rest of it.
    without_glow = plain & ~np.isin(asked.owner, groups.object[groups.lamp])
    asked = asked.of(without_glow if 2 * without_glow.sum() > plain.sum() else plain)
    bound = groups.bound[lamps].astype(np.float64)
    found = looked_at_closely(
        surface,
        _with_estimates(lit, groups, first),
        environment,
        frames,
        asked,
        groups.as_lamps(lamps),
        bound * first.multiplier[lamps].mean(axis=1),
        seed,
    )
    error = np.hypot(found.error, LEAST_ERROR)
    multiplier = found.radiance / bound[:, None]
    brightest = multiplier.max(axis=1)
    better = (error <= MAX_ERROR) & (np.log(brightest) > -2 * error)
    estimate = EstimatedRadiance(**{name: kept.copy() for name, kept in vars(first).items()})
    held = multiplier / np.minimum(brightest, 1)[:, None]
    estimate.multiplier[lamps[better]] = held[better]
    estimate.standard_error[lamps[better]] = error[better, None]
    estimate.determined[lamps[better]] = evenly[lamps[better]] = True
    return estimate, evenly


def _chosen(texels: Texels, groups: ClippedGroups, measured: Bool, seed: int) -> tuple[Long, Int]:
    """Measured texels spread over all objects, denser near the lamps, and their segments."""
    usable = np.flatnonzero(measured & texels.interior & (groups.group < 0))
    segment = texels.segments(usable)
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
    kept = np.sort(first_of_segments(rank, segment, numbers, each))
    return usable[kept], segment[kept]
