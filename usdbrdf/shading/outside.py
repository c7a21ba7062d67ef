"""The light from outside: what frames show of it, and the rest by the light that it casts.

What texels reflect is their albedo times S, and S is the light of what was seen, that of patches of
sky that no frame shows, the sun's, and that of lamps that no frame measures. Contrasts on one side
of one object tell of the light: first of the sun's direction (``sun_direction``), then of its
irradiance and the patches' and lamps' radiance (``outside_light``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.job.progress import say
from usdbrdf.job.task import TaskRun
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading.asked import (
    LEAST_OF_SEGMENT,
    PER_SEGMENT,
    Shining,
    asked_texels,
    first_of_segments,
    irradiance_of_texels,
    looked_around,
)
from usdbrdf.shading.gloss import Mirrored, mirroring
from usdbrdf.shading.hidden_light import KnownLamps, light_of_hidden
from usdbrdf.shading.lamp_light import Lamps, beside_others, brought, shining, sources_of, without
from usdbrdf.shading.likely_lamps import beside_daylight
from usdbrdf.shading.outside_light import Asked, Solution, Sources, jackknife, levelled, solved
from usdbrdf.shading.sun_direction import find_sun
from usdbrdf.shading.surroundings import HEIGHT, WIDTH, Surroundings, surroundings_from_frames
from usdbrdf.transport.environment import (
    NO_SUN,
    Environment,
    Sun,
    directions_of_pixels,
    pixels_of_directions,
)
from usdbrdf.transport.lit_scene import TexturedScene
from usdbrdf.transport.sunlight import sunlit

# Rays by which each of the texels asked meets the sky: at first, and where it does.
_FIRST_RAYS, _RAYS = 32, 1024
# To be chosen from, and texels to the side of one that see, up to this difference of their cosine
# to it, as much of the sun.
_MANY_PER_SEGMENT, _AROUND, _AS_SUNLIT = 960, 2, 0.05
# What surfaces mirror follows from the light that was found before; then it is as it was told.
_LOOKS_AT_MIRRORED, _AS_TOLD = 2, (1.0, 0.0)
# Where more of the sunlit texels are clear of shadows than this, all of them tell more.
_MOSTLY_CLEAR = 0.5
# Lower and upper elevation of a band of patches, degrees, and their number.
_BANDS = (
    (-90, -30, 4), (-30, 0, 12), (0, 8, 24), (8, 16, 24), (16, 28, 24), (28, 42, 16), (42, 65, 8),
    (65, 90, 1),
)  # fmt: skip
_LEAST_SHARE = calibration.number("outside.least_share")
_LEAST_OPEN = calibration.number("outside.least_open")
_HIDDEN_BY_NIGHT = calibration.number("outside.hidden_by_night")
# Of a sky that no frame shows: through a slit it is believed in only if that much is known of it.
_SLIT = calibration.number("outside.slit")
_MOST_SKY_ERROR = calibration.number("outside.most_sky_error")
_BESIDE = calibration.number("outside.alike_within")
_SEED = 0x51C4
_DARKEST = 1e-3  # of what is usual: darker sky is none
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
    def is_inferred(self) -> bool:
        """More than what a file tells or frames show."""
        return not (math.isnan(self.sky_error) and math.isnan(self.sun_error))

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
) -> Outside | None:
    """What the frames show of the surroundings, and what they tell of the rest. said: of objects
    whether they are lamps, where that is known."""

    def compute() -> dict[str, Array]:
        seen = surroundings_from_frames(surface.rays, frames, z_up)
        # What hides in a room would shine like what stands in the sun beside it.
        lamps, known = KnownLamps.unknown(coverage.clipped), _of_measured(seen, z_up)
        light = light_of_hidden(surface, lit, coverage, known, seed, lamps)
        mirrored = mirroring(surface, light, frames, seed)
        given = surface, light, coverage, seen, z_up, seed
        found = light_from_outside(*given, mirrored, said)
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
) -> Outside | None:
    """What lights the scan ``lit`` (T, 3), L_d, from outside; None where hardly a direction of its
    light leaves it. seen: what the frames show of it; mirrored: what surfaces mirror to these, None
    where ``lit`` holds nothing of that; said: of objects whether they are lamps, where that is
    known."""
    asked = asked_texels(surface.texels, lit, coverage, seed)
    if asked is None:
        return None
    measured, clipped = seen.coverage.measured, seen.coverage.clipped
    # What long exposures alone show may be no brighter than the rest.
    limit = seen.radiance.max(axis=1) * clipped
    patches = _patches(limit > limit.max() / 2, z_up)
    unseen = np.where(measured, -1, patches)
    # A look around first: of a closed room a few rays tell that it is.
    for rays in (_FIRST_RAYS, _RAYS):
        share, open_share = _shares(surface, asked, unseen, z_up, seed, rays)
        if open_share < _LEAST_OPEN:
            return None
    say(f"shade: {100 * open_share:.0f} % of the light's directions leave the scan")
    hidden = float(share.mean(axis=1).sum()) / np.pi
    if (
        seen.is_night() and hidden < _HIDDEN_BY_NIGHT * open_share
    ):  # as all that is seen, so the rest
        radiance = _picture(seen, patches, np.zeros(0, np.int64), np.zeros((0, 3)), z_up)
        confidence = seen.coverage.stored().reshape(HEIGHT, WIDTH)
        environment = Environment(radiance, z_up)
        return Outside(environment=environment, confidence=confidence, open_share=open_share)
    used = np.flatnonzero(share.mean(axis=1) > _LEAST_SHARE * np.pi)
    look = _Look(surface, lit, seen, patches, used, z_up, seed)
    look, lamps, all_told = _with_lamps(look, asked, share, coverage, said)
    asked, sky, sun, with_sun, found = all_told
    light = asked.irradiance + sky.irradiance(found.log_radiance[:-1])
    if mirrored is not None:
        for _ in range(_LOOKS_AT_MIRRORED):
            strengths: Double = np.exp(found.log_radiance)
            outside = Environment(look.picture(strengths), z_up)
            in_sun = outside.under(sun._replace(irradiance=strengths[-1]))
            asked = asked._replace(mirrored=mirrored(in_sun, asked.texel))
            sky = sky._replace(gloss=_AS_TOLD)
            with_sun = _with_sun(surface, asked, sky, sun, seed)
            found = solved(*with_sun)
        light = asked.irradiance + sky.irradiance(found.log_radiance[:-1])
    strength = float(np.exp(found.log_radiance[-1]).mean() / np.median(light.mean(axis=1)))
    error = jackknife(*with_sun, found)
    # What no texel sees keeps what was thought of it before, and errs by nothing.
    sees = np.count_nonzero(with_sun[1].share[-1]) >= LEAST_OF_SEGMENT
    shines = sees and error[-1].max() < _MOST_SUN_ERROR and strength > _LEAST_SUN
    if shines:
        many = asked_texels(surface.texels, lit, coverage, seed, _MANY_PER_SEGMENT)
        assert many is not None
        if (clear := _clearly_lit(surface, many, sun, seed)) is not None:
            share, _ = _shares(surface, clear, unseen, z_up, seed, _RAYS)
            clear, of_clear = look.at(clear, share)
            if mirrored is not None:
                clear = clear._replace(mirrored=mirrored(in_sun, clear.texel))
            # As those before told it.
            of_clear = sky._replace(share=of_clear.share)
            clearly = _with_sun(surface, clear, of_clear, sun, seed)
            told = solved(*clearly)
            own_error = jackknife(*clearly, told)
            if own_error[-1].max() < _MOST_CLEAR_ERROR:
                with_sun, found, error = clearly, told, own_error
        found = levelled(*with_sun, found)
        sun = sun._replace(irradiance=np.exp(found.log_radiance[-1]))
    else:
        if mirrored is not None:
            asked = asked._replace(mirrored=mirrored(outside, asked.texel))
        sun, found = NO_SUN, solved(asked, sky)
        found, error = levelled(asked, sky, found), jackknife(asked, sky, found)
    radiance_of_sky = np.exp(found.log_radiance[: len(used)])
    radiance = look.picture(radiance_of_sky)
    # By the light that each brings: nobody asks how dark dark ground is.
    weight = share[used].mean(axis=1) * radiance_of_sky.mean(axis=1)
    of_sky = error[: len(used)].max(axis=1)
    sky_error = float(np.average(of_sky, weights=weight)) if len(used) else math.nan
    invented = not measured.any() and not shines and not sky_error < _MOST_SKY_ERROR
    if invented and open_share < _SLIT:
        return None
    return Outside(
        environment=Environment(radiance, z_up).under(sun),
        confidence=seen.coverage.stored().reshape(HEIGHT, WIDTH),
        open_share=open_share,
        sky_error=sky_error,
        sun_error=float(error[-1].max()) if shines else math.nan,
        lamps=lamps,
    )


class _Look(NamedTuple):
    """How a scan of radiance ``lit`` (T, 3) is asked for light from outside: by what was ``seen``
    of it, by those of the patches (D,) of all directions that are ``used``, and by lamps beside it.
    """

    surface: TexturedScene
    lit: Float
    seen: Surroundings
    patches: Int
    used: Long
    z_up: bool
    seed: int
    lamps: Lamps | None = None

    def at(self, asked: Asked, share: Double) -> tuple[Asked, Sources]:
        """The texels asked with S, W/m^2, of all that frames measured, and the other sources: those
        of the patches, of which all bring ``share`` (P, N), and the lamps."""
        surface, environment = self.surface, _of_measured(self.seen, self.z_up)
        lit = self.lit if self.lamps is None else without(self.lit, self.lamps)
        shining = Shining.of(surface, lit, environment)
        irradiance = irradiance_of_texels(surface, shining, environment, asked.texel, self.seed)
        least = _DARK * np.median(asked.reflected)
        asked = asked._replace(irradiance=np.maximum(irradiance, least).astype(np.float64))
        sky = _sky(asked, self.seen, self.patches, share, self.used, self.z_up)
        if self.lamps is None:
            return asked, sky
        lamps = sources_of(self.lamps, brought(surface, self.lamps, asked.texel, self.seed))
        return asked, sky._replace(
            share=np.concatenate([sky.share, lamps.share]),
            mean=np.concatenate([sky.mean, lamps.mean]),
            deviation=np.append(sky.deviation, lamps.deviation),
            bound=np.append(sky.bound, lamps.bound),
        )

    def picture(self, radiance: Double) -> Float:
        """(HEIGHT, WIDTH, 3): what was measured, and the patches, whose radiance comes first."""
        radiance = radiance[: len(self.used)]
        return _picture(self.seen, self.patches, self.used, radiance, self.z_up)


class _Told(NamedTuple):
    """The texels asked and the sources but the sun; where that stands; those of them that see all
    of its disc or none and the sources with it, the last; and their strengths."""

    asked: Asked
    sources: Sources
    sun: Sun
    with_sun: tuple[Asked, Sources]
    found: Solution


def _with_lamps(
    look: _Look, asked: Asked, share: Double, coverage: CoverageMap, said: Mapping[int, bool]
) -> tuple[_Look, Long, _Told]:
    """How the scan is asked for daylight and for what shines beside it, the numbers of the objects
    among these, and what it tells."""
    told = _told(look, asked, share)
    # Lamps beside it would brighten the sky, and all the less the farther they are: as it is, it
    # does not explain them.
    picture = Environment(look.picture(np.exp(told.found.log_radiance)), look.z_up)
    under_sun = picture.under(told.sun._replace(irradiance=np.exp(told.found.log_radiance[-1])))
    beside = beside_daylight(
        look.surface, look.lit, coverage, under_sun, told.asked, look.seed, said
    )
    while len(beside):
        lamps = beside.lamps(look.surface.texels)
        look = look._replace(lamps=lamps)
        told = _told(look, asked, share)
        of_objects = slice(len(look.used), len(look.used) + len(beside.likely.object))
        near, part = beside_others(*told.with_sun, told.found)
        shines = shining(np.exp(told.found.log_radiance), near, part)[of_objects]
        shines |= lamps.certain[: len(shines)]
        if shines.all():
            return look, beside.likely.object, told
        beside = beside.of(shines)
    if look.lamps is not None:
        look = look._replace(lamps=None)
        told = _told(look, asked, share)
    return look, np.zeros(0, np.int64), told


def _told(look: _Look, asked: Asked, share: Double) -> _Told:
    # Patches that had to stand for the sun brighten what it shines on: once it is found, its place
    # is looked for again.
    asked, sources = look.at(asked, share)
    light, sun = asked.irradiance + sources.irradiance(sources.mean), None
    for _ in range(3):
        sun = find_sun(look.surface, asked, light, look.z_up, sun)
        with_sun = _with_sun(look.surface, asked, sources, sun, look.seed)
        found = solved(*with_sun)
        light = asked.irradiance + sources.irradiance(found.log_radiance[:-1])
    assert sun is not None
    return _Told(asked, sources, sun, with_sun, found)


def _of_measured(seen: Surroundings, z_up: bool) -> Environment:
    """What frames measured, and no light from elsewhere."""
    known = np.where(seen.coverage.measured[:, None], seen.radiance, np.float32(0))
    return Environment(known.reshape(HEIGHT, WIDTH, 3), z_up)


def _clearly_lit(surface: TexturedScene, asked: Asked, sun: Sun, seed: int) -> Asked | None:
    """Of the texels asked those around which all see as much of the sun, as many of each segment in
    its light as in shadow where there are; None if hardly one is in the sun, or most of those are
    such already.

    Pixels mix sunlight and shadow, most so in the stripes of blinds: what then is too bright in the
    shadows passes for light from all around the sun."""
    share, clear = sunlit(surface, asked.texel, sun, seed), np.ones(len(asked.texel), np.bool_)
    for beside in surface.texels.around(asked.texel, _AROUND):
        clear &= np.abs(sunlit(surface, beside, sun, seed) - share) < _AS_SUNLIT
    if clear[share > 0].mean() > _MOSTLY_CLEAR:
        return None
    every = np.arange(int(asked.segment.max()) + 1)
    halves = [
        first_of_segments(np.flatnonzero(clear & part), asked.segment, every, PER_SEGMENT // 2)
        for part in (share > 0, share <= 0)
    ]
    if len(halves[0]) < LEAST_OF_SEGMENT:
        return None
    return asked.of(np.sort(np.concatenate(halves)))


def _patches(clipped: Bool, z_up: bool) -> Int:
    """(D,) the patch of the sky of each direction: bands of azimuths; what clips is in patches of
    its own, whose numbers follow."""
    directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    up, x = directions[:, 2 if z_up else 1], directions[:, 0]
    ahead = -directions[:, 1] if z_up else directions[:, 2]
    elevation, turn = np.degrees(np.arcsin(np.clip(up, -1, 1))), np.arctan2(x, ahead) / (2 * np.pi)
    patch, first = np.zeros(len(directions), np.int32), 0
    for low, high, count in _BANDS:
        band = (elevation >= low) & (elevation <= high)
        patch[band] = first + np.floor((turn[band] % 1.0) * count).astype(np.int32) % count
        first += count
    return np.where(clipped, patch + first, patch).astype(np.int32)


_PATCHES = sum(count for _, _, count in _BANDS)


def _shares(
    surface: TexturedScene, asked: Asked, patches: Int, z_up: bool, seed: int, rays: int
) -> tuple[Double, float]:
    """By so many rays from each, what a patch (-1: none) of radiance 1 brings to the texels asked,
    (2 _PATCHES, N), W/m^2; and the share of the light's directions that leave the scan."""
    count = len(asked.texel)
    towards, face = looked_around(surface, asked.texel, seed ^ _SEED, rays)
    out = np.flatnonzero(face < 0)
    patch = patches[pixels_of_directions(towards[out], HEIGHT, WIDTH, z_up)]
    texel, kept = out % count, patch >= 0
    met = np.bincount(patch[kept] * count + texel[kept], minlength=2 * _PATCHES * count)
    brought = np.asarray(np.pi / rays * met.reshape(2 * _PATCHES, count), np.float64)
    return brought, len(out) / len(towards)


_ABOVE_LIMIT = calibration.pair("outside.above_limit")
_SKY_DEVIATION = calibration.number("outside.sky_deviation")
_ALIKE = calibration.number("outside.alike")
_ALIKE_OVER_HORIZON = calibration.number("outside.alike_over_horizon")
_SUN_DEVIATION = calibration.number("outside.sun_deviation")
_LEAST_SUN = calibration.number("outside.least_sun")
_MOST_SUN_ERROR = calibration.number("outside.most_sun_error")
_MOST_CLEAR_ERROR = calibration.number("outside.most_clear_error")


def _sky(
    asked: Asked, seen: Surroundings, patches: Int, share: Double, used: Long, z_up: bool
) -> Sources:
    """The patches that light what is asked."""
    known, usual = seen.coverage.measured, seen.trend(z_up)
    # Where all is dark that was seen, but not all that lights the scan was, the rest is not.
    if not usual.any() or seen.is_night():
        usual = np.tile(np.median(asked.reflected, axis=0) / np.pi, (len(usual), 1))
    bound = used >= _PATCHES
    darkest = max(_DARKEST * float(np.median(usual.max(axis=1))), 1e-30)
    mean = np.zeros((len(used), 3))
    directions = directions_of_pixels(HEIGHT, WIDTH, z_up).reshape(-1, 3)
    centre = np.zeros((len(used), 3))
    for k, patch in enumerate(used):
        centre[k] = directions[patches % _PATCHES == patch % _PATCHES].mean(axis=0)
        near = known & (directions @ centre[k] > np.cos(_BESIDE) * np.linalg.norm(centre[k]))
        if bound[k]:
            mean[k] = np.log(seen.radiance[patches == patch].max(axis=0)) + _ABOVE_LIMIT[0]
        elif near.any():
            mean[k] = np.log(np.maximum(np.median(seen.radiance[near], axis=0), darkest))
        else:
            mean[k] = np.log(np.maximum(usual[patches == patch], darkest)).mean(axis=0)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    near = np.argwhere(np.triu(centre @ centre.T > np.cos(_BESIDE), 1))
    near = near[~bound[near].any(axis=1)]
    below = centre[:, 2 if z_up else 1] < 0
    apart = np.where(below[near[:, 0]] == below[near[:, 1]], _ALIKE, _ALIKE_OVER_HORIZON)
    deviation = np.where(bound, _ABOVE_LIMIT[1], _SKY_DEVIATION)
    return Sources(share[used], mean, deviation, bound, near, apart)


def _with_sun(
    surface: TexturedScene, asked: Asked, sky: Sources, sun: Sun, seed: int
) -> tuple[Asked, Sources]:
    """The sun as the last of the sources; without the texels that see some of its disc only, whose
    share of it is not known as well as that."""
    share = sunlit(surface, asked.texel, sun, seed).astype(np.float64)
    cosine = np.maximum(surface.texels.normal[asked.texel] @ sun.direction, 0)
    kept = (share < 0.02 * cosine + 1e-6) | (share > 0.98 * cosine)
    strength = np.log(np.median(asked.irradiance + sky.irradiance(sky.mean), axis=0))
    sources = Sources(
        share=np.concatenate([sky.share, share[None]])[:, kept],
        mean=np.concatenate([sky.mean, strength[None]]),
        deviation=np.append(sky.deviation, _SUN_DEVIATION),
        bound=np.append(sky.bound, False),
        pairs=sky.pairs,
        apart=sky.apart,
        gloss=sky.gloss,
    )
    return asked.of(kept), sources


def _picture(seen: Surroundings, patches: Int, used: Long, radiance: Double, z_up: bool) -> Float:
    """(HEIGHT, WIDTH, 3): what was measured, and the patches."""
    filled = seen.trend(z_up)
    for patch, value in zip(used, radiance, strict=True):
        filled[patches == patch] = value
    filled = np.where(seen.coverage.clipped[:, None], np.maximum(filled, seen.radiance), filled)
    known = seen.coverage.measured[:, None]
    return np.where(known, seen.radiance, filled).reshape(HEIGHT, WIDTH, 3).astype(np.float32)
