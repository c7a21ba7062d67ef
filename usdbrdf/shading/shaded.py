"""The lit texture becomes irradiance, albedo and emitters (paper, section 3.3).

S holds everything but a texel's own emission, so pi L_d / S well above 1 is impossible for a
reflector: such texels shine by themselves."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap, Texels
from usdbrdf.options import BEFORE_FILTER, Sampling
from usdbrdf.shading.base_color import albedo_map, clear_of
from usdbrdf.shading.clipped_groups import clipped_groups
from usdbrdf.shading.clipped_light import ClippedLight, estimate_clipped_light
from usdbrdf.shading.doubt import doubt_of_irradiance, doubt_of_outside, shines_evenly
from usdbrdf.shading.hidden_light import KnownLamps, said_to_shine, with_hidden_light
from usdbrdf.shading.outside import Outside
from usdbrdf.shading.outside_light import doubt_by_views
from usdbrdf.shading.panes import beside_panes
from usdbrdf.shading.unseen_lamps import UnseenLamps, estimate_unseen_lamps
from usdbrdf.texturing.inpaint import telling
from usdbrdf.transport.denoise import OIDN, denoise_lightmaps
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.irradiance import Irradiance, irradiance_at, tiles_of_texels, whole_tiles
from usdbrdf.transport.lights import Lights
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.sunlight import sunlight
from usdbrdf.transport.surface_texture import SurfaceTexture

_WHOLE_LAMP = calibration.number("emitters.whole_lamp")
_MIN_PATCH = calibration.count("emitters.min_texels")
# In the light of lamps found they are asked for again, so many times in all at most.
_LAMP_ROUNDS = 3


@dataclass(frozen=True, kw_only=True)
class Emitters:
    """emissive (T,) bool per texel; is_lamp (num_objects,) bool: the object shines as a whole;
    radiance (num_objects, 3) float32: area-weighted mean of its emissive, seen texels that are
    brighter than what they reflect (0 where there are none); lower_bound (num_objects,) bool:
    less than a tenth of that area was ever seen unsaturated, so the radiance can only be larger."""

    emissive: Bool
    is_lamp: Bool
    radiance: Float
    lower_bound: Bool


def find_emitters(
    texels: Texels,
    radiance: Float,
    irradiance: Float,
    seen: Bool,
    clipped: Bool,
    unknown_lamp: float = 0.0,
    unseen_lamps: Int | None = None,
    said: Mapping[int, bool] = MappingProxyType({}),
    doubt: float = 0.0,
    observed: Bool | None = None,
    doubt_of_whole: Double | None = None,
) -> Emitters:
    """Emissive texels from L_d and S (T, 3), grouped per object.

    seen (T,): the texel's radiance was observed; clipped (T,): only as a lower bound.
    unknown_lamp: the radiance, a lower bound, of a lamp that is in S with no more than that, as
    ``ClippedLight.least_of_lamps``. S is then too dark, so that dimmer measured surfaces exceed it
    without shining. 0 if there is none.
    unseen_lamps: numbers of the objects that shine though no frame shows them; of these
    ``lower_bound`` is True
    said: of objects whether they shine as a whole or not at all, whatever they show
    doubt: relative standard error of S, of which what shines must be clear: what stands in a sun
    that is known badly is no lamp
    observed (T,): by which of the texels seen or clipped an object is a lamp as a whole, all by
    default: of a bulb of glass the inside, which no frame shows, is lit by all the rest of it
    """
    light = radiance.mean(axis=1)
    # A texel that no light reaches is dark, not a lamp: it must also beat the scene's median.
    bright = (light > np.median(light)) & (clipped | (radiance.max(axis=1) >= unknown_lamp))
    sends, receives = np.pi * light, irradiance.mean(axis=1)
    shines = bright & (sends > clear_of(doubt) * receives)
    as_whole = shines
    if doubt_of_whole is not None:
        limit = clear_of(doubt_of_whole)[texels.object_index()]
        as_whole = bright & (sends > limit * receives)
    known = seen | clipped
    emissive = np.zeros(len(texels), np.bool_)
    num_objects = len(texels.resolution)
    is_lamp = np.zeros(num_objects, np.bool_)
    mean = np.zeros((num_objects, 3), np.float32)
    lower_bound = np.zeros(num_objects, np.bool_)
    for i in range(num_objects):
        own = texels.of_object(i)
        area = np.where(known[own], texels.area[own], 0)
        shown = area if observed is None else area * observed[own]
        is_lamp[i] = (shown * as_whole[own]).sum() > _WHOLE_LAMP * shown.sum()
        is_lamp[i] &= np.count_nonzero(as_whole[own] & known[own]) >= telling(len(area))
        is_lamp[i] = said.get(i, is_lamp[i])
        if is_lamp[i]:
            emissive[own] = True
        elif i not in said:
            emissive[own] = _connected(texels, i, shines[own] & known[own])
        unseen = unseen_lamps is not None and i in unseen_lamps
        if unseen or (is_lamp[i] and not area.any()):
            is_lamp[i], lower_bound[i], emissive[own] = True, True, True
            mean[i] = radiance[own].mean(axis=0)
            continue
        glows = emissive[own] & (as_whole if is_lamp[i] else shines)[own] & (area > 0)
        weight = area * (glows if glows.any() else emissive[own])
        exact = weight * seen[own]
        # Some of a lamp is often seen in long exposures alone; what the short one shows counts.
        lower_bound[i] = exact.sum() < 0.1 * weight.sum()
        if not lower_bound[i]:
            weight = exact
        if weight.sum() > 0:
            mean[i] = (radiance[own] * weight[:, None]).sum(axis=0) / weight.sum()
    return Emitters(emissive=emissive, is_lamp=is_lamp, radiance=mean, lower_bound=lower_bound)


def _connected(texels: Texels, index: int, shines: Bool) -> Bool:
    """Keep only groups of at least _MIN_PATCH texels that touch each other in the atlas."""
    if np.count_nonzero(shines) < _MIN_PATCH:
        return np.zeros_like(shines)
    width, height = texels.resolution[index]
    picture = np.zeros(width * height, np.bool_)
    local = texels.pixel[texels.of_object(index)] - texels.first_pixel[index]
    picture[local] = shines
    label, _ = ndimage.label(picture.reshape(height, width), np.ones((3, 3)))
    large = np.bincount(label.ravel()) >= _MIN_PATCH
    large[0] = False
    return np.asarray(large[label.ravel()[local]], np.bool_)


# Irradiance is traced and saved in pieces of this many texels: what a kill can cost, and what
# bounds the memory of the ray buffers.
_TILE = 1 << 15
TileTrace: TypeAlias = Callable[[Any, Any, Any], Mapping[str, Array]]


class _Tiles(NamedTuple):
    """What is traced of texels, in their ``order`` (T,) of ``tiles_of_texels`` with the ``patch``
    (T,) of each: ``trace`` is given ``scene``, and numbers and patches of some."""

    trace: TileTrace
    scene: Any
    order: Long
    patch: Int


def _tile(tiles: _Tiles, ends: tuple[int, int]) -> Mapping[str, Array]:
    part = slice(*ends)
    return tiles.trace(tiles.scene, tiles.order[part], tiles.patch[part])


def by_tiles(
    run: TaskRun, texels: Texels, name: str, label: str, trace: TileTrace, scene: Any
) -> dict[str, Array]:
    """Arrays of all texels, of which ``trace``, a function at the top of a module, finds those of a
    tile, given the ``scene``, their numbers and patches; each is kept under ``name``."""
    order, patch = tiles_of_texels(texels)
    pieces = {
        f"{name}-{number}": (part.start, part.stop)
        for number, part in enumerate(whole_tiles(patch, _TILE))
    }
    tiles = _Tiles(trace, scene, order, patch)
    found = run.units(_tile, tiles, pieces, label=label, noun="tiles")
    back = np.argsort(order)
    return {key: np.concatenate([some[key] for some in found])[back] for key in found[0]}


class _LitTexels(NamedTuple):
    """What irradiance is traced in; dark (T,) W/m^2, see ``irradiance_at``."""

    surface: TexturedScene
    radiance: SurfaceTexture
    lights: Lights
    environment: Environment
    sampling: Sampling
    dark: Float


def _irradiance(given: _LitTexels, index: Long, patch: Int) -> dict[str, Array]:
    surface, texels = given.surface, given.surface.texels
    found = irradiance_at(
        surface.light_rays, given.radiance, given.lights, given.environment, texels.position[index],
        texels.normal[index], patch, given.sampling, surface.diagonal_m, given.dark[index],
    )  # fmt: skip
    mean = found.mean + sunlight(surface, index, given.environment.sun, given.sampling.seed)
    return {**vars(found), "mean": mean}


def trace_irradiance(
    run: TaskRun, surface: TexturedScene, lit: Float, environment: Environment, sampling: Sampling
) -> Irradiance:
    """S at all texels with the radiance ``lit`` (T, 3) as the light."""
    texels = surface.texels
    radiance, lights = surface.texture(lit), surface.lights_of(lit, environment)
    # In less light than this the texel's albedo would be over 1 and is not to be had: lamps, and
    # surfaces lit from outside the scan.
    dark = np.pi * lit.mean(axis=1)
    say(f"shade: {len(texels):,} texels, {len(lights.face):,} bright triangles")
    given = _LitTexels(surface, radiance, lights, environment, sampling, dark)
    return Irradiance(**by_tiles(run, texels, "tile", "shade", _irradiance, given))


def denoised_irradiance(texels: Texels, irradiance: Float) -> Float:
    """Each object's S (T, 3) through the lightmap filter."""
    pictures = (texels.image(i, irradiance) for i in range(len(texels.resolution)))
    filtered = denoise_lightmaps(pictures)
    return np.concatenate([texels.from_image(i, picture) for i, picture in enumerate(filtered)])


# What is worth a warning: shares of the known texels with an albedo over 1, and of light's
# directions that leave the scan; the relative standard error of S; an albedo of coal, which half
# of what reflects has where pixels were decoded twice.
_MANY_OVER_ONE, _MOSTLY_OPEN, _NOISY, _COAL = 0.05, 0.5, 0.2, 0.03


@dataclass(frozen=True)
class Shaded:
    """What is known of all texels.

    measured        (T,): a frame does
    light           L_d (T, 3) with the estimated radiance of lamps that clipped, and with what
                    other surfaces reflect that no frame measures
    unseen          lamps that no frame shows
    traced          S as it was traced
    relative_error  (T,) float32 of that
    irradiance      (T, 3) float32, W/m^2: S as it is used; ``traced.mean`` itself if not filtered
    emitters        what shines by itself
    albedo          (T, 3) float32 in [0, 1], 0 on emitters
    unexplained     (T,): more comes from a measured reflector than reaches it, its albedo is 1
    over_one        the share of these
    outside         the light from outside; None for none
    panes           the numbers of the objects that light passes through
    """

    measured: Bool
    light: ClippedLight
    unseen: UnseenLamps
    traced: Irradiance
    relative_error: Float
    irradiance: Float
    emitters: Emitters
    albedo: Float
    unexplained: Bool
    over_one: float
    outside: Outside | None
    panes: tuple[int, ...] = ()

    @property
    def emission(self) -> Float:
        """(T, 3) W/(m^2 sr): what shines by itself, zero elsewhere."""
        return np.where(self.emitters.emissive[:, None], self.light.lit, np.float32(0))

    @property
    def hidden(self) -> Float:
        """(T, 3) W/(m^2 sr): what texels that no frame measures are taken to reflect, zero on all
        else."""
        known = self.measured | self.emitters.emissive
        return np.where(known[:, None], np.float32(0), self.light.lit)

    def radiance_status(self, index: int) -> str:
        """How the radiance of what shines on an object is known: "measured"; where no frame
        shows it, or all clip, "estimated" from the light that it casts, or "lowerBound"."""
        if not self.emitters.lower_bound[index]:
            return "measured"
        return "lowerBound" if math.isnan(self.radiance_error(index)) else "estimated"

    def radiance_error(self, index: int) -> float:
        """Relative standard error of an object's estimated radiance, else NaN."""
        if not self.emitters.lower_bound[index]:
            return math.nan
        error = self.unseen.error_of(index)
        return self.light.error_of_object(index) if math.isnan(error) else error

    def doubts(self, identifiers: Sequence[str]) -> Iterator[str]:
        """Sentences about what a person should look at; identifiers: of the objects."""
        if not self.emitters.emissive.any() and not self.outside:
            yield "no emitter was found, so a relit stage will be dark. [shading.no-light]"
        for i, identifier in enumerate(identifiers):
            status = self.radiance_status(i)
            if status == "lowerBound":
                yield (
                    f"{identifier}: saturated in every frame, its radiance is only a lower bound. "
                    "Capture a shorter exposure. [shading.clipped]"
                )
            elif status == "estimated":
                radiance = ", ".join(f"{value:.3g}" for value in self.emitters.radiance[i])
                hidden = i in self.unseen.object
                how = "no frame shows it" if hidden else "saturated in every frame"
                what = "Photograph it" if hidden else "Capture a shorter exposure"
                yield (
                    f"{identifier}: {how}; from the light that it casts its "
                    f"radiance is {radiance}, +-{100 * self.radiance_error(i):.0f} %. {what} "
                    "to measure it. [shading.estimated]"
                )
        error = float(np.median(self.relative_error))
        if error > _NOISY:
            yield (
                f"half of the texels have an irradiance with a relative standard error of "
                f"{100 * error:.0f} % or more. Allow more --rays, or ask for a smaller "
                "--standard-error. [shading.noise]"
            )
        if self.over_one > _MANY_OVER_ONE:
            yield (
                f"{100 * self.over_one:.0f} % of the seen texels have an albedo over 1 and were "
                "clamped. Check the exposures, or give the missing light as --environment. "
                "[shading.albedo]"
            )
        reflects = self.albedo[self.measured & ~self.emitters.emissive]
        middle = float(np.median(reflects)) if len(reflects) else math.nan
        if middle < _COAL:
            yield (
                f"half of what the frames show has an albedo under {middle:.2g}, as coal has. "
                "Check that the pixels are linear and were not decoded twice, and the exposures. "
                "[shading.dark]"
            )
        escaped = float(self.traced.escaped.mean())
        if escaped > _MOSTLY_OPEN and not self.outside:
            yield (
                f"{100 * escaped:.0f} % of the light's directions leave the scan and count as "
                "black. Give the surroundings as --environment. [shading.open]"
            )
        elif escaped > _MOSTLY_OPEN and self.outside and self.outside.is_estimated:
            yield (
                f"{100 * escaped:.0f} % of the light's directions leave the scan. What no frame "
                "shows of its light is inferred, its level from albedos that are usual. Give the "
                "surroundings as --environment to measure it. [shading.open]"
            )

    def summary(self, identifiers: Sequence[str]) -> dict[str, Any]:
        """Figures of the whole scene, JSON; identifiers: of the objects."""
        lamps = [i for i in range(len(identifiers)) if self.emitters.is_lamp[i]]
        return {
            "rays_per_texel": float(self.traced.rays.mean()),
            "standard_error": float(np.median(self.relative_error)),
            "escaped_fraction": float(self.traced.escaped.mean()),
            "emitters": [identifiers[i] for i in lamps],
            "estimated_emitters": {
                identifiers[i]: self.radiance_error(i)
                for i in lamps
                if self.radiance_status(i) == "estimated"
            },
            "albedo_over_one": self.over_one,
        }


def _light(
    run: TaskRun,
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    outside: Outside | None,
    seed: int,
    said: Mapping[int, bool],
    differing: Callable[[], Double] | None,
) -> tuple[ClippedLight, UnseenLamps]:
    """L_d with what hidden surfaces send on, and with the lamps that no frame measures."""
    environment = outside.environment if outside else black_environment()
    texels, filled = surface.texels, lit
    doubt = doubt_of_outside(outside, lit, coverage.measured)
    owner = texels.object_index()
    groups = clipped_groups(texels, lit, coverage, said)
    told = said_to_shine(texels, said)
    # What clips may be a lamp, or reflect what is not known yet.
    may_shine = told | coverage.clipped | groups.texels_of(groups.lamp)
    # In the light of what it may be that no frame shows.
    shine = said if outside is None else {int(i): True for i in outside.lamps} | dict(said)
    known = KnownLamps(may_shine, said, doubt=doubt)
    measured = lit, coverage, environment, seed, known
    lit, unseen = _lit_by_unseen_lamps(run, surface, *measured, frames, shine)
    of_unseen = np.isin(owner, unseen.object)
    light = estimate_clipped_light(
        run, surface, lit, coverage, frames, environment, seed, said,
        of_unseen if of_unseen.any() else None, differing,
    )  # fmt: skip
    lamps = light.groups.texels_of(light.groups.lamp) | of_unseen
    if (light.lit[lamps] == filled[lamps]).all() and not (may_shine & ~told & ~lamps).any():
        return light, unseen
    # Hidden surfaces send on the light of these as well; what clips and is no lamp reflects it.
    known = KnownLamps(told | lamps, said, doubt=doubt)
    given = light.lit, filled, coverage, environment, seed, known
    return replace(light, lit=with_hidden_light(run, "hidden-lit", surface, *given)), unseen


def _lit_by_unseen_lamps(
    run: TaskRun,
    surface: TexturedScene,
    filled: Float,
    coverage: CoverageMap,
    environment: Environment,
    seed: int,
    known: KnownLamps,
    frames: Frames,
    shine: Mapping[int, bool],
) -> tuple[Float, UnseenLamps]:
    """L_d, ``filled`` (T, 3) where no frame measures it, with the lamps that no frame shows and
    what hidden surfaces send on. What these send on of one lamp's light looks like another's, so
    lamps are asked for again in that light, until they remain the same."""
    owner, lit, unseen = surface.texels.object_index(), filled, UnseenLamps.none()
    for number in range(_LAMP_ROUNDS):
        before, shines = unseen.object, np.isin(owner, unseen.object)
        lamps = known._replace(texel=known.texel | shines)
        given = lit, filled, coverage, environment, seed, lamps
        lit = with_hidden_light(run, f"hidden-{number}", surface, *given)
        asked = lit, coverage, frames, environment, seed, shine
        unseen = estimate_unseen_lamps(run, f"unseen-{number}", surface, *asked)
        lit = unseen.with_light(surface.texels, np.where(shines[:, None], filled, lit))
        if np.array_equal(unseen.object, before):
            break
    if len(unseen.object):
        say(f"shade: {len(unseen.object)} lamps that no frame shows, by the light that they cast")
    return lit, unseen


def shade_surface(
    run: TaskRun,
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    frames: Frames,
    outside: Outside | None,
    sampling: Sampling,
    lightmap_filter: str,
    said: Mapping[int, bool] = MappingProxyType({}),
    differing: Callable[[], Double] | None = None,
) -> Shaded:
    """Trace S with the light ``lit`` (T, 3), L_d as texturing left it; divide; find the emitters.

    run      keeps what is done for a run that goes on
    frames   which views L_d is from
    outside  the light from outside; None for none
    said     of objects, by number, whether they are lamps, where a person says so
    differing  tells how far the views of one texel differ, as ``AssetMaps.differing``
    """
    environment = outside.environment if outside else black_environment()
    # What panes show is sent by what is behind them: they are no lamps, whatever their radiance.
    said, panes = {**said, **dict.fromkeys(surface.panes, False)}, surface.of_panes()
    sent = *beside_panes(surface, lit, coverage), frames, outside, sampling.seed, said
    light, unseen = _light(run, surface, *sent, differing)
    filtered = lightmap_filter == OIDN
    if filtered:
        sampling = replace(sampling, standard_error=BEFORE_FILTER * sampling.standard_error)
    traced = trace_irradiance(run, surface, light.lit, environment, sampling)
    irradiance = denoised_irradiance(surface.texels, traced.mean) if filtered else traced.mean
    light = replace(light, lit=np.where(panes[:, None], lit, light.lit))
    texels, seen = surface.texels, coverage.measured
    may_shine = light.may_shine(coverage.clipped)
    doubt = doubt_of_irradiance(texels, light, unseen, outside, seen, irradiance)
    dimmest = light.least_of_lamps(clear_of(doubt) / np.pi * irradiance.max(axis=1))
    # What shows by its evenness that it shines need not be clear of lamps that are known badly;
    # what mirrors an even wall looks alike, but another way from each side.
    even = shines_evenly(texels, light.lit, irradiance, traced.standard_error, seen)
    if even.any() and differing is not None:
        even &= doubt_by_views(differing()) <= 1
    of_whole = np.where(even, doubt_of_outside(outside, light.lit, seen), doubt)
    emitters = find_emitters(
        texels, light.lit, irradiance, seen, may_shine, dimmest, unseen.object, said, doubt,
        coverage.observed, of_whole,
    )  # fmt: skip
    told = coverage.tells_albedo
    albedo, over = albedo_map(texels, light.lit, irradiance, told, emitters.emissive)
    over &= seen & ~panes
    level = np.maximum(traced.mean.mean(axis=1), 1e-30)
    relative = np.sqrt((traced.standard_error**2).mean(axis=1)) / level
    return Shaded(
        measured=coverage.measured, light=light, traced=traced, relative_error=relative,
        irradiance=irradiance, unseen=unseen, emitters=emitters, albedo=albedo, unexplained=over,
        outside=outside, panes=surface.panes,
        over_one=float(over.sum() / max((seen & ~panes & ~emitters.emissive).sum(), 1)),
    )  # fmt: skip
