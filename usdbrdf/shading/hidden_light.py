"""The light of what no frame measures: undersides, backs, what stands behind something; and what is
so bright that it clips in all of them, as walls in the sun do.

Texturing fills the former with the radiance beside it, which knows nothing of the light there: the
underside of a table would shine like its top in the sun. What was seen of an object tells its
albedo, and what receives S sends out

    L = albedo S / pi

and no less than it shows where it clips. S is traced at some of the texels with all other light; in
two rounds, for hidden surfaces see each other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from usdbrdf import calibration
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Float, Long
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.options import Sampling
from usdbrdf.shading.asked import Shining, irradiance_of_texels
from usdbrdf.shading.base_color import NEUTRAL, albedo_where_lit, clear_of
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.transport.environment import Environment
from usdbrdf.transport.lit_scene import TexturedScene

# Texels at which S is traced, of those that are seen and of those that are not, in all; of one
# object no fewer than these.
_TRACED, _LEAST_OF_OBJECT = 1 << 15, 48
# From each: their means are asked for, not what each of them receives.
_RAYS = 64
_ROUNDS = 2
_SEED = 0x41D
_AS_A_WHOLE = calibration.number("hidden.shines_as_a_whole")
# Texels around what was seen that are no more than so many times as bright as their fill.
_RIM, _LEAK = 3, 2.0


class KnownLamps(NamedTuple):
    """What may shine, ``texel`` (T,), keeps its radiance; so do objects more than a part
    ``most`` of whose seen texels send out more than they can reflect, but for those of ``said``,
    by number, whose lamps a person knows. doubt: relative standard error of what is received."""

    texel: Bool
    said: Mapping[int, bool]
    most: float = 0.5
    doubt: float = 0.0

    @classmethod
    def unknown(cls, clipped: Bool) -> KnownLamps:
        """Nothing is known of lamps, nor where the sun shines: what stands in it is told from a
        lamp by its sides, which are in the shade; what is ``clipped`` (T,) may be either."""
        return cls(clipped, {}, _AS_A_WHOLE)


def said_to_shine(texels: Texels, said: Mapping[int, bool]) -> Bool:
    """(T,): the texels of those objects of which a person says that they are lamps."""
    lamps = [number for number, is_lamp in said.items() if is_lamp]
    return np.asarray(np.isin(texels.object_index(), lamps), np.bool_)


def with_hidden_light(
    run: TaskRun,
    name: str,
    surface: TexturedScene,
    lit: Float,
    filled: Float,
    coverage: CoverageMap,
    environment: Environment,
    seed: int,
    lamps: KnownLamps,
) -> Float:
    """``light_of_hidden`` from ``lit`` (T, 3), what is known of it, on; ``filled`` (T, 3) is L_d as
    texturing left it. What this changes is kept under ``name``."""
    lamplit = np.where((coverage.shown | lamps.texel)[:, None], lit, filled)

    def compute() -> dict[str, Array]:
        light = light_of_hidden(surface, lamplit, coverage, environment, seed, lamps, lit)
        changed = np.flatnonzero((light != lamplit).any(axis=1))
        return {"texel": changed, "light": light[changed]}

    found, light = run.checkpoint(name, compute), lamplit.copy()
    light[found["texel"]] = found["light"]
    return light


def light_of_hidden(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    environment: Environment,
    seed: int,
    lamps: KnownLamps,
    start: Float | None = None,
) -> Float:
    """(T, 3) W/(m^2 sr): ``lit``, L_d, and of texels that no frame measures or glimpses what they
    reflect of it and of the ``environment``, but for ``lamps``. start (T, 3): what is known of that
    before."""
    texels, known = surface.texels, coverage.tells_albedo | lamps.texel
    every = np.flatnonzero(~known)
    seen = _spread(texels, coverage.tells_albedo & ~lamps.texel)
    # Apart, for of a small part that clips little is traced among all that hides.
    kinds = (~known & coverage.clipped, ~known & ~coverage.clipped)
    hidden = np.union1d(*(_spread(texels, kind) for kind in kinds))
    if not len(hidden) or not len(seen):
        return lit
    beside = beside_seen(texels, coverage.observed | lamps.texel)[every]
    bounded = coverage.clipped[every]
    filled, light, both = lit[every], lit.copy(), np.concatenate([seen, hidden])
    if start is not None:
        light[every] = start[every]
    for number in range(_ROUNDS):
        shining = Shining.of(surface, light, environment)
        sampling = Sampling(standard_error=0, max_rays=_RAYS)
        traced = irradiance_of_texels(
            surface, shining, environment, both, (seed ^ _SEED) + number, sampling
        )
        receives, reaches = traced[: len(seen)], traced[len(seen) :]
        albedo, lamp = _albedo(texels, seen, lit[seen], receives, every, lamps)
        sent = albedo * _spread_out(texels, hidden, reaches, every) / np.pi
        sent = without_leaks(sent, filled, beside)
        # Whole, with its hue: one channel alone may have clipped.
        held = bounded & (filled.max(axis=1) > sent.max(axis=1))
        sent[held] = filled[held]
        light[every] = np.where(lamp[:, None], filled, sent)
    return light


def _albedo(
    texels: Texels, seen: Long, lit: Float, irradiance: Float, every: Long, lamps: KnownLamps
) -> tuple[Float, Bool]:
    """Albedo (M, 3) of the texels ``every`` (M,) by that of those that are ``seen`` (N,), and which
    of them are of objects that shine."""
    owner, count = texels.object_index(), len(texels.resolution)
    ratio, known = albedo_where_lit(lit, irradiance, np.ones(len(seen), np.bool_))
    # Where lamps are not known yet, what they shine on seems to reflect more than it receives.
    usual = max(1.0, float(np.median(ratio[known])) if known.any() else NEUTRAL)
    ratio /= usual
    shines = known & (ratio.mean(axis=1) > clear_of(lamps.doubt))
    num_known, num_shining = (np.bincount(owner[seen], kind, count) for kind in (known, shines))
    lamp = num_shining > lamps.most * num_known
    # S is sharp, and pixels are not: in the stripes of blinds half of what is no lamp may exceed
    # it. All of it together does not.
    sends, receives = (
        np.bincount(owner[seen], np.where(known, light.mean(axis=1), 0), count)
        for light in (np.pi * lit / usual, irradiance)
    )
    lamp &= sends > clear_of(lamps.doubt) * receives
    for number, is_lamp in lamps.said.items():
        lamp[number] = is_lamp
    # What the sun shines on is as white as anything until it is known.
    reflects = known & (~shines | (num_shining == num_known)[owner[seen]])
    albedo = _spread_out(texels, seen[reflects], np.minimum(ratio, 1)[reflects], every)
    albedo[(num_known == 0)[owner[every]]] = NEUTRAL
    return albedo, lamp[owner[every]]


def beside_seen(texels: Texels, shown: Bool) -> Bool:
    """Texels (T,) that are not ``shown`` and are read together with shown ones, or lie before
    those: the last ones before a wall few frames show."""
    found = np.zeros(len(texels), np.bool_)
    for i in range(len(texels.resolution)):
        near = binary_dilation(texels.image(i, shown), np.ones((3, 3)), iterations=_RIM)
        found[texels.of_object(i)] = texels.from_image(i, near)
    return found & ~shown


def without_leaks(sent: Float, filled: Float, beside: Bool) -> Float:
    """What texels (N,) send, (N, 3), but what was filled in, (N, 3), where they lie ``beside`` seen
    ones and would be much brighter than that: beyond the foot of a wall they may lie in the sun,
    and are read together with what was seen before it."""
    leaks = beside & (sent.mean(axis=1) > _LEAK * filled.mean(axis=1))
    return np.where(leaks[:, None], filled, sent)


def _spread(texels: Texels, which: Bool) -> Long:
    """Of the texels ``which`` (T,) some of each object, evenly, by its part of their area."""
    total = float(texels.area[which].sum())
    chosen = []
    for i in range(len(texels.resolution)):
        own = texels.of_object(i)
        some = own.start + np.flatnonzero(which[own])
        share = float(texels.area[some].sum()) / max(total, 1e-30)
        number = min(len(some), max(_LEAST_OF_OBJECT, round(_TRACED * share)))
        chosen.append(some[np.linspace(0, len(some) - 1, number).astype(np.int64)])
    return np.concatenate(chosen) if chosen else np.zeros(0, np.int64)


def _spread_out(texels: Texels, index: Long, values: Float, every: Long) -> Float:
    """(M, 3) at texels ``every`` (M,) of the values (N, 3) at texels ``index`` (N,)."""
    # Of the table the rows that matter: a large scene's has many more.
    rows = np.union1d(index, every)
    table = replace(texels.take(rows), first_texel=np.searchsorted(rows, texels.first_texel))
    whole, told = np.zeros((len(rows), 3), np.float32), np.zeros(len(rows), np.bool_)
    place = np.searchsorted(rows, index)
    whole[place], told[place] = values, True
    return inpaint(table, whole, told)[np.searchsorted(rows, every)]
