"""The light from outside: what frames show of it, and the rest by the light that it casts.

What texels reflect is their albedo times S, and S is the light of what was seen, that of patches of
sky that no frame shows, the sun's, and that of lamps that no frame measures. Contrasts on one side
of one object tell of the light: first of the sun's direction (``sun_direction``), then of its
irradiance and the patches' and lamps' radiance (``outside_light``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import product
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading.asked import (
    LEAST_OF_SEGMENT,
    PER_SEGMENT,
    Shining,
    asked_texels,
    first_of_segments,
    irradiance_of_texels,
)
from usdbrdf.shading.gloss import Mirrored, mirroring
from usdbrdf.shading.hidden_light import KnownLamps, light_of_hidden
from usdbrdf.shading.lamp_light import (
    MOST_OF_CERTAIN,
    Lamps,
    beside_others,
    brought,
    known_well,
    shining,
    sources_of,
    without,
)
from usdbrdf.shading.likely_lamps import beside_daylight
from usdbrdf.shading.outside_light import Asked, Solution, Sources, jackknife, levelled, solved
from usdbrdf.shading.sky_patches import (
    FIRST_RAYS,
    enough_rays,
    patches_of_sky,
    picture_of_sky,
    shares_of_sky,
    sources_in_sky,
)
from usdbrdf.shading.sun_direction import find_sun, with_disc
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, Surroundings, surroundings_from_frames
from usdbrdf.transport.environment import NO_SUN, Environment, Sun
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.sunlight import sunlit

# To be chosen from, and texels to the side of one that see, up to this difference of their cosine
# to it, as much of the sun.
_MANY_PER_SEGMENT, _AROUND, _AS_SUNLIT = 960, 2, 0.05
# Texels from one to those over which what pixels mix is mixed as well.
_MIXED = (-4, -2, 0, 2, 4)
# What surfaces mirror follows from the light that was found before; then it is as it was told.
_LOOKS_AT_MIRRORED, _AS_TOLD = 2, (1.0, 0.0)
# With the disc that was found the sun is stronger, and its disc is looked at again.
_LOOKS_AT_DISC = 2
# Where more of the sunlit texels are clear of shadows than this, all of them tell more.
_MOSTLY_CLEAR = 0.5
_LEAST_SHARE = calibration.number("outside.least_share")
_LEAST_OPEN = calibration.number("outside.least_open")
_HIDDEN_BY_NIGHT = calibration.number("outside.hidden_by_night")
# Of a sky that no frame shows: through a slit it is believed in only if that much is known of it.
_SLIT = calibration.number("outside.slit")
_MOST_SKY_ERROR = calibration.number("outside.most_sky_error")
_DARK = 1e-4  # of what is reflected: less than that is no light to compare with


@dataclass(frozen=True, kw_only=True)
class Outside:
    """The light from outside, and how it is known.

    environment   what rays that leave the scan meet
    confidence    (H, W) float32: 1 where frames show it, or a file tells; 0.5 where it clips in all
                  of them, 0 where it is inferred
    open_share    of the light's directions that leave the scan; NaN if a file tells the light
    sky_error     relative standard error of what is inferred; NaN where nothing is
    sun_error     relative standard error of the sun's irradiance; NaN without a sun, or a file's
    lamps         (K,) int64: objects that no frame shows and that must shine beside it
    """

    environment: Environment
    confidence: Float
    open_share: float = math.nan
    sky_error: float = math.nan
    sun_error: float = math.nan
    lamps: Long = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def given(cls, environment: Environment) -> Outside:
        """By a file, which is believed."""
        return cls(
            environment=environment, confidence=np.ones(environment.image.shape[:2], np.float32)
        )

    @property
    def is_estimated(self) -> bool:
        """Not told by a file."""
        return not math.isnan(self.open_share)

    @property
    def doubt(self) -> float:
        """Relative standard error of the light that is inferred; 0 where none is."""
        errors = (self.sky_error, self.sun_error)
        return max((error for error in errors if not math.isnan(error)), default=0.0)

    def arrays(self) -> dict[str, Array]:
        """All of it."""
        image, z_up, sun = self.environment.image, self.environment.z_up, self.environment.sun
        disc = [*sun.direction, *sun.irradiance, sun.half_angle]
        numbers = [z_up, self.open_share, self.sky_error, self.sun_error, *disc]
        return {
            "image": image,
            "confidence": self.confidence,
            "numbers": np.array(numbers),
            "lamps": self.lamps,
        }

    @classmethod
    def restored(cls, arrays: Mapping[str, Array]) -> Outside:
        """What ``arrays`` once returned."""
        z_up, open_share, sky, sun_error, *disc = arrays["numbers"].tolist()
        sun = Sun(np.array(disc[:3]), np.array(disc[3:6]), disc[6])
        return cls(
            environment=Environment(arrays["image"], bool(z_up)).under(sun),
            confidence=arrays["confidence"],
            open_share=open_share,
            sky_error=sky,
            sun_error=sun_error,
            lamps=arrays["lamps"],
        )


def estimated_outside(
    run: TaskRun,
    surface: TexturedScene,
    frames: Frames,
    lit: Float,
    coverage: CoverageMap,
    z_up: bool,
    seed: int,
    said: Mapping[int, bool] = MappingProxyType({}),
    differing: Callable[[], Double] | None = None,
) -> Outside | None:
    """What the frames show of the surroundings, and what they tell of the rest. said: of objects
    whether they are lamps, where that is known; differing: as of ``levelled``."""

    def compute() -> dict[str, Array]:
        seen = surroundings_from_frames(surface.light_rays, frames, z_up)
        # What hides in a room would shine like what stands in the sun beside it.
        lamps, known = KnownLamps.unknown(coverage.clipped), _of_measured(seen, z_up)
        light = light_of_hidden(surface, lit, coverage, known, seed, lamps)
        mirrored = mirroring(surface, light, frames, seed)
        given = surface, light, coverage, seen, z_up, seed
        found = light_from_outside(*given, mirrored, said, differing)
        return found.arrays() if found else {"nothing": np.zeros(0)}

    arrays = run.checkpoint("outside", compute)
    return None if "nothing" in arrays else Outside.restored(arrays)


def light_from_outside(
    surface: TexturedScene,
    lit: Float,
    coverage: CoverageMap,
    seen: Surroundings,
    z_up: bool,
    seed: int,
    mirrored: Mirrored | None = None,
    said: Mapping[int, bool] = MappingProxyType({}),
    differing: Callable[[], Double] | None = None,
) -> Outside | None:
    """What lights the scan ``lit`` (T, 3), L_d, from outside; None where hardly a direction of its
    light leaves it. seen: what the frames show of it; mirrored: what surfaces mirror to these, None
    where ``lit`` holds nothing of that; said, differing: as of ``estimated_outside``."""
    asked = asked_texels(surface.texels, lit, coverage, seed)
    if asked is None:
        return None
    measured, clipped = seen.coverage.measured, seen.coverage.clipped
    # What long exposures alone show may be no brighter than the rest.
    limit = seen.radiance.max(axis=1) * clipped
    patches = patches_of_sky(limit > limit.max() / 2, z_up)
    none = np.zeros(0, np.int64)
    look = _Look(surface, lit, coverage, seen, patches, none, z_up, seed, mirrored)
    for _ in range(2):  # a look around first: of a closed room a few rays tell that it is
        share, open_share = look.shares(asked)
        if open_share < _LEAST_OPEN:
            return None
        look = look._replace(rays=enough_rays(open_share))
    say(f"shade: {100 * open_share:.0f} % of the light's directions leave the scan")
    confidence = seen.coverage.stored().reshape(HEIGHT, WIDTH)
    hidden = float(share.mean(axis=1).sum()) / np.pi
    if seen.is_night() and hidden < _HIDDEN_BY_NIGHT * open_share:  # the rest is as what is seen
        as_seen = look.picture(np.zeros((0, 3)))
        return Outside(environment=as_seen, confidence=confidence, open_share=open_share)
    look = look._replace(used=np.flatnonzero(share.mean(axis=1) > _LEAST_SHARE * np.pi))
    look, lamps, told = _with_lamps(look, asked, share, said)
    if mirrored is not None:
        told = _beside_mirrored(look, told)
    error = jackknife(*told.with_sun, told.found)
    sun_shines = _sun_shines(told, error)
    told, error = _in_shadows(look, told, error) if sun_shines else _sunless(look, told)
    found = levelled(*told.with_sun, told.found, differing)
    sky, of_sky = np.exp(found.log_radiance[: len(look.used)]), error[: len(look.used)].max(axis=1)
    # By the light that each brings: nobody asks how dark dark ground is.
    weight = told.sources.share[: len(look.used)].mean(axis=1) * sky.mean(axis=1)
    sky_error = float(np.average(of_sky, weights=weight)) if len(look.used) else math.nan
    invented = not measured.any() and not sun_shines and not sky_error < _MOST_SKY_ERROR
    if invented and open_share < _SLIT:
        return None
    sun = told.sun._replace(irradiance=np.exp(found.log_radiance[-1])) if sun_shines else NO_SUN
    return Outside(
        environment=look.picture(sky).under(sun),
        confidence=confidence,
        open_share=open_share,
        sky_error=sky_error,
        sun_error=float(error[-1].max()) if sun_shines else math.nan,
        lamps=lamps,
    )


class _Look(NamedTuple):
    """How a scan of radiance ``lit`` (T, 3) and its coverage is asked for light from outside: by
    what was ``seen`` of it, by those of the patches (D,) of all directions that are ``used``, and
    by lamps beside it; and what surfaces mirror to the frames, None for nothing."""

    surface: TexturedScene
    lit: Float
    coverage: CoverageMap
    seen: Surroundings
    patches: Int
    used: Long
    z_up: bool
    seed: int
    mirrored: Mirrored | None
    rays: int = FIRST_RAYS
    lamps: Lamps | None = None

    def shares(self, asked: Asked) -> tuple[Double, float]:
        """As of ``shares_of_sky``, of the patches where nothing was measured."""
        unseen = np.where(self.seen.coverage.measured, -1, self.patches)
        return shares_of_sky(self.surface, asked, unseen, self.z_up, self.seed, self.rays)

    def at(self, asked: Asked, share: Double) -> tuple[Asked, Sources]:
        """The texels asked, but the lamps', with S, W/m^2, of all that frames measured, and the
        other sources: those of the patches, of which all bring ``share`` (P, N), and the lamps."""
        surface, environment = self.surface, _of_measured(self.seen, self.z_up)
        lit = self.lit
        if self.lamps is not None:
            plain = self.lamps.of[asked.texel] < 0
            lit, asked, share = without(lit, self.lamps), asked.of(plain), share[:, plain]
        lights = Shining.of(surface, lit, environment)
        irradiance = irradiance_of_texels(surface, lights, environment, asked.texel, self.seed)
        least = _DARK * np.median(asked.reflected)
        asked = asked._replace(irradiance=np.maximum(irradiance, least).astype(np.float64))
        sky = sources_in_sky(asked, self.seen, self.patches, share, self.used, self.z_up)
        if self.lamps is None:
            return asked, sky
        lamps = sources_of(self.lamps, brought(surface, self.lamps, asked.texel, self.seed))
        return asked, sky._replace(
            share=np.concatenate([sky.share, lamps.share]),
            mean=np.concatenate([sky.mean, lamps.mean]),
            deviation=np.append(sky.deviation, lamps.deviation),
            family=np.append(sky.family, lamps.family),
        )

    def picture(self, radiance: Double) -> Environment:
        """What was measured, and the patches, whose radiance comes first; without the sun."""
        radiance = radiance[: len(self.used)]
        picture = picture_of_sky(self.seen, self.patches, self.used, radiance, self.z_up)
        return Environment(picture, self.z_up)

    def under_sun(self, told: _Told) -> Environment:
        """What was told, with the sun."""
        radiance: Double = np.exp(told.found.log_radiance)
        return self.picture(radiance).under(told.sun._replace(irradiance=radiance[-1]))


class _Told(NamedTuple):
    """The texels asked and the sources but the sun; where that stands; those of them that see all
    of its disc or none and the sources with it, the last; and their strengths."""

    asked: Asked
    sources: Sources
    sun: Sun
    with_sun: tuple[Asked, Sources]
    found: Solution

    def light(self) -> Double:
        """(N, 3) S of the texels asked, in the shade."""
        return self.asked.irradiance + self.sources.irradiance(self.found.log_radiance[:-1])


def _with_lamps(
    look: _Look, asked: Asked, share: Double, said: Mapping[int, bool]
) -> tuple[_Look, Long, _Told]:
    """How the scan is asked for daylight and for what shines beside it, the numbers of the objects
    among these, and what it tells."""
    told = _told(look, asked, share)
    of_daylight = look, np.zeros(0, np.int64), told
    # Lamps beside it would brighten the sky, and all the less the farther they are: as it is, it
    # does not explain them.
    beside = beside_daylight(
        look.surface, look.lit, look.coverage, look.under_sun(told), told.asked, look.seed, said
    )
    while beside.count:
        lamps = beside.lamps(look.surface.texels)
        look = look._replace(lamps=lamps)
        told = _told(look, asked, share)
        of_objects = slice(len(look.used), len(look.used) + len(beside.likely.object))
        near, part = beside_others(*told.with_sun, told.found)
        shines = shining(np.exp(told.found.log_radiance), near, part)[of_objects]
        if shines.any():
            shines &= (
                jackknife(*told.with_sun, told.found)[of_objects].max(axis=1) < MOST_OF_CERTAIN
            )
        shines |= lamps.certain[: len(shines)]
        if shines.all():
            return look, beside.likely.object, told
        beside = beside.of(shines)
    return of_daylight


def _told(look: _Look, asked: Asked, share: Double) -> _Told:
    """Where the sun stands, and the strengths of all."""
    # Patches that had to stand for the sun brighten what it shines on: once it is found, its place
    # is looked for again.
    asked, sources = look.at(asked, share)
    light, sun = asked.irradiance + sources.irradiance(sources.mean), None
    for _ in range(3):
        sun = find_sun(look.surface, asked, light, look.z_up, sun)
        told = _solved(look, asked, sources, sun)
        light = told.light()
    return told


def _solved(look: _Look, asked: Asked, sources: Sources, sun: Sun) -> _Told:
    """The strengths that explain best what the texels asked reflect, with the ``sun`` there."""
    with_sun = _with_sun(look.surface, asked, sources, sun, look.seed)
    return _Told(asked, sources, sun, with_sun, solved(*with_sun))


def _beside_mirrored(look: _Look, told: _Told) -> _Told:
    """The same where surfaces mirror what was told."""
    assert look.mirrored is not None
    for _ in range(_LOOKS_AT_MIRRORED):
        seen = look.mirrored(look.under_sun(told), told.asked.texel)
        sources = told.sources._replace(gloss=_AS_TOLD)
        told = _solved(look, told.asked._replace(mirrored=seen), sources, told.sun)
    return told


def _sun_shines(told: _Told, error: Double) -> bool:
    """error (K, 3): of the sources with the sun."""
    strength = np.exp(told.found.log_radiance[-1]).mean() / np.median(told.light().mean(axis=1))
    # What no texel sees keeps what was thought of it before, and errs by nothing.
    sees = np.count_nonzero(told.with_sun[1].share[-1]) >= LEAST_OF_SEGMENT
    _, part = beside_others(*told.with_sun, told.found)
    known = known_well(error[-1:].max(axis=1), part[-1:], _MOST_SUN_ERROR)
    return bool(sees and known[0] and strength > _LEAST_SUN)


def _sunless(look: _Look, told: _Told) -> tuple[_Told, Double]:
    """The same without the sun, and the errors of its sources, (K, 3)."""
    asked = told.asked
    if look.mirrored is not None:
        sky = look.picture(np.exp(told.found.log_radiance))
        asked = asked._replace(mirrored=look.mirrored(sky, asked.texel))
    without_sun = asked, told.sources
    found = solved(*without_sun)
    told = told._replace(asked=asked, sun=NO_SUN, with_sun=without_sun, found=found)
    return told, jackknife(*without_sun, found)


def _in_shadows(look: _Look, told: _Told, error: Double) -> tuple[_Told, Double]:
    """The same with the sun's disc as half-shadows show it, and as strong as it is told best where
    shadows are blurred; and the errors, (K, 3).

    Pixels mix sunlight and shadow, most so in the stripes of blinds: what then is too bright in the
    shadows passes for light from all around the sun, and what is too dark between them for a weak
    one. Two ways around that: texels that lie clear of shadows' edges, where there are such; and
    means over more than a pixel, which are those of what falls there, whatever it mixes."""
    before = told
    for _ in range(_LOOKS_AT_DISC):
        sun = told.sun._replace(irradiance=np.exp(told.found.log_radiance[-1]))
        found = with_disc(look.surface, told.asked, told.light(), sun, look.seed)
        if found is sun:
            break
        told = _solved(look, told.asked, told.sources, found)
    if told is not before:
        error = jackknife(*told.with_sun, told.found)
    ways = [_clear_of_shadows(look, told, error), _as_pixels_mix(look, told)]
    well = [way for way in ways if way and way[1][-1].max() < _MOST_CLEAR_ERROR]
    return min(well, key=lambda way: float(way[1][-1].max()), default=(told, error))


def _clear_of_shadows(look: _Look, told: _Told, error: Double) -> tuple[_Told, Double] | None:
    """By texels around which all see as much of the sun, as many of each segment in its light as in
    shadow where there are; as they are where most of those in the sun are such; None where too few
    are."""
    surface = look.surface
    many = asked_texels(surface.texels, look.lit, look.coverage, look.seed, _MANY_PER_SEGMENT)
    assert many is not None
    share, clear = sunlit(surface, many.texel, told.sun, look.seed), np.ones(len(many.texel), bool)
    for beside in surface.texels.around(many.texel, _AROUND):
        clear &= np.abs(sunlit(surface, beside, told.sun, look.seed) - share) < _AS_SUNLIT
    if clear[share > 0].mean() > _MOSTLY_CLEAR:
        return told, error
    every = np.arange(int(many.segment.max()) + 1)
    halves = [
        first_of_segments(np.flatnonzero(clear & part), many.segment, every, PER_SEGMENT // 2)
        for part in (share > 0, share <= 0)
    ]
    if len(halves[0]) < LEAST_OF_SEGMENT:
        return None
    some = many.of(np.sort(np.concatenate(halves)))
    some, sources = look.at(some, look.shares(some)[0])
    if look.mirrored is not None:
        some = some._replace(mirrored=look.mirrored(look.under_sun(told), some.texel))
    # As those before told it.
    sources = told.sources._replace(share=sources.share)
    by_clear = _solved(look, some, sources, told.sun)
    return by_clear, jackknife(*by_clear.with_sun, by_clear.found)


def _as_pixels_mix(look: _Look, told: _Told) -> tuple[_Told, Double] | None:
    """By the means over what lies around each of the texels asked, on the same wall; by those alone
    around which no sun is; and by what clips as a bound. None where too few in the sun have a wall
    around them."""
    surface, asked = look.surface, told.asked
    texels, centre, whole = surface.texels, asked.texel, ~asked.clipped
    reflected, share = np.zeros_like(asked.reflected), np.zeros(len(centre))
    sunny = np.zeros(len(centre), np.bool_)
    for right, down in product(_MIXED, repeat=2):
        beside, there = texels.beside_on_surface(centre, right, down)
        own = sunlit(surface, beside, told.sun, look.seed)
        whole &= there & look.coverage.measured[beside]
        sunny |= there & (own > 0)
        reflected += np.pi * look.lit[beside] / len(_MIXED) ** 2
        share += own / len(_MIXED) ** 2
    if np.count_nonzero(whole & (share > 0)) < LEAST_OF_SEGMENT:
        return None
    share = np.where(whole, share, sunlit(surface, centre, told.sun, look.seed))
    kept = whole | asked.clipped | ~sunny
    mixed = asked._replace(reflected=np.where(whole[:, None], reflected, asked.reflected))
    sources = _and_sun(told.sources, asked, share)
    with_sun = mixed.of(kept), sources._replace(share=sources.share[:, kept])
    found = solved(*with_sun)
    return told._replace(with_sun=with_sun, found=found), jackknife(*with_sun, found)


def _of_measured(seen: Surroundings, z_up: bool) -> Environment:
    """What frames measured, and no light from elsewhere."""
    known = np.where(seen.coverage.measured[:, None], seen.radiance, np.float32(0))
    return Environment(known.reshape(HEIGHT, WIDTH, 3), z_up)


_SUN_DEVIATION = calibration.number("outside.sun_deviation")
_LEAST_SUN = calibration.number("outside.least_sun")
_MOST_SUN_ERROR = calibration.number("outside.most_sun_error")
_MOST_CLEAR_ERROR = calibration.number("outside.most_clear_error")


def _with_sun(
    surface: TexturedScene, asked: Asked, sky: Sources, sun: Sun, seed: int
) -> tuple[Asked, Sources]:
    """The sun as the last of the sources; without the texels that see some of its disc only, whose
    share of it is not known as well as that."""
    share = sunlit(surface, asked.texel, sun, seed).astype(np.float64)
    cosine = np.maximum(surface.texels.normal[asked.texel] @ sun.direction, 0)
    kept = (share < 0.02 * cosine + 1e-6) | (share > 0.98 * cosine)
    sources = _and_sun(sky, asked, share)
    return asked.of(kept), sources._replace(share=sources.share[:, kept])


def _and_sun(sky: Sources, asked: Asked, share: Double) -> Sources:
    """The sources with the sun as the last, which brings ``share`` (N,) to the texels asked."""
    strength = np.log(np.median(asked.irradiance + sky.irradiance(sky.mean), axis=0))
    return Sources(
        share=np.concatenate([sky.share, share[None]]),
        mean=np.concatenate([sky.mean, strength[None]]),
        deviation=np.append(sky.deviation, _SUN_DEVIATION),
        family=np.append(sky.family, 0),
        pairs=sky.pairs,
        apart=sky.apart,
        gloss=sky.gloss,
    )
