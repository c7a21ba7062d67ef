"""L_d without the specular light that its frames hold, and the base colour that follows.

The median of the frames keeps the specular reflection that is seen from everywhere: by 2 to 130 %
it made albedos too large. With the lobes known it is taken off every single sample, and what pixels
mix with it (``refined_means``); what they blurred is restored where it stands above the noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from usdbrdf.ahead import ahead
from usdbrdf.files.frames import FrameReader
from usdbrdf.job.progress import progress
from usdbrdf.job.task import TaskRun
from usdbrdf.material.refined_irradiance import Lobes, let_through_surfaces, refined_irradiance
from usdbrdf.material.refined_means import (
    MOST_SAMPLES,
    OF_NOISE_FLOOR,
    RELATIVE_ERROR,
    Lighting,
    bytes_of_refining,
    level_of,
    light_of,
    means_without_lobes,
    subsample,
    texels_at_once,
)
from usdbrdf.model.arrays import Array, Bool, Float
from usdbrdf.model.capture import Frames
from usdbrdf.shading.base_color import Reflection, base_color_of
from usdbrdf.shading.hidden_light import beside_seen, without_leaks
from usdbrdf.texturing.footprints import around, restored
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.texturing.observe import frames_in_view
from usdbrdf.texturing.passes import (
    BytesPerTexel,
    among_workers,
    bytes_for_frames,
    in_passes,
    shares_of,
    with_rows_beside,
)
from usdbrdf.texturing.pattern_pixels import REACH, Covering, PatternedSurface, pixels_of_frame
from usdbrdf.texturing.patterns import BYTES_OF_EQUATIONS, ROWS_BESIDE, steps_of, with_patterns
from usdbrdf.texturing.robust_mean import RobustMean
from usdbrdf.texturing.samples import Picture
from usdbrdf.transport.brdf import DIELECTRIC, F0_OF_PSI
from usdbrdf.transport.denoise import OIDN
from usdbrdf.transport.let_through import share_seen
from usdbrdf.transport.lit_scene import LitScene

# Bytes that a texel takes while patterns are told.
_OF_PATTERNS = BytesPerTexel(grouped=BYTES_OF_EQUATIONS, result=28, after=60, always=44, pixel=450)


@dataclass(frozen=True, kw_only=True)
class Refined:
    """diffuse (T, 3) W/(m^2 sr): L_d without specular light; irradiance (T, 3) W/m^2: S of that and
    of the lobes, as it counts for what dielectrics scatter below their surface and is seen from the
    front; base_color (T, 3) in [0, 1]: pi L_d / S but for what pixels mix (``light_on_pixels``), F0
    of a metal; of several lightings the mean of what each tells, the same for all."""

    diffuse: Float
    irradiance: Float
    base_color: Float


def refined_light(
    run: TaskRun,
    lightings: Sequence[Lighting],
    reader: FrameReader,
    lobes: Lobes,
    lightmap_filter: str,
    memory: float | None,
    seed: int,
) -> list[Refined]:
    """What the frames of each lighting show of T texels without the specular light of the
    ``lobes``: L_d, S and base colour; in as many passes over the frames as ``memory`` (GiB) asks
    for.

    Where no frame measured a texel the base colour is filled in from its object's measured ones,
    and L_d is what it reflects of S, but filled in as well where it lies beside seen texels and
    would be much brighter; what shines keeps the radiance with which it shines.
    """
    texels, need = lightings[0].lit.texels, bytes_of_refining([one.lit for one in lightings])
    owner = texels.object_index()
    metal = lobes.conducts[owner]
    shown = [_told(run, one, reader, lobes, need, memory, seed) for one in lightings]
    if len(lightings) > 1:
        shown = [
            told._replace(error=np.hypot(told.error, one.before.irradiance_error))
            for one, told in zip(lightings, shown, strict=True)
        ]
    own = [told.in_own_light for told in shown]
    besides = [
        beside_seen(texels, one.before.coverage.observed | one.before.emissive) for one in lightings
    ]

    def reflected(irradiance: Sequence[Float], sent: Sequence[Float]) -> tuple[Float, list[Float]]:
        """Base colour, and what is ``sent`` in each lighting with what is reflected where nobody
        looked or all frames clipped."""
        found = [_reflection(*each) for each in zip(lightings, shown, irradiance, strict=True)]
        base_color = base_color_of(texels, found)
        return base_color, [
            _with_hidden(base_color, *each) for each in zip(found, sent, besides, strict=True)
        ]

    # A texel lights others by what it sends itself, not by what the pixels around it mix.
    _, light = reflected([one.before.irradiance for one in lightings], own)
    irradiance, seen = [], np.ones((len(texels), 1), np.float32)
    if lightings[0].lit.lobe == DIELECTRIC:
        seen[~metal] = share_seen(lobes.phi, lobes.psi)[owner[~metal], None]
    for (name, lit, before, _), sent in zip(lightings, light, strict=True):
        change = np.where(before.emissive[:, None], 0, sent - before.light).astype(np.float32)
        traced = before.traced_irradiance if lightmap_filter == OIDN else before.irradiance
        part = run.part(name)
        refined = refined_irradiance(part, lit, traced, change, lobes, lightmap_filter, seed)
        sent = np.where(before.emissive[:, None], before.emission, sent).astype(np.float32)
        refined = refined + let_through_surfaces(part, lit, sent, lobes, seed)
        irradiance.append(np.asarray(np.maximum(refined, 0) / seen, np.float32))
    base_color, diffuse = reflected(irradiance, [told.diffuse for told in shown])
    reflects = metal & ~np.all([one.before.emissive for one in lightings], axis=0)
    base_color[reflects] = F0_OF_PSI * lobes.psi[owner[reflects]]
    return [
        Refined(diffuse=one.astype(np.float32), irradiance=incoming, base_color=base_color)
        for one, incoming in zip(diffuse, irradiance, strict=True)
    ]


class _Told(NamedTuple):
    """What the frames of a lighting tell of T texels: L_d (T, 3) without its specular light, as
    pixels mix it; the same of each texel in its own light, of which it tells the albedo, see
    ``light_on_pixels``; and the standard deviation (T,) relative to it, infinite where no frame
    measured it."""

    diffuse: Float
    in_own_light: Float
    error: Float


def _told(
    run: TaskRun,
    lighting: Lighting,
    reader: FrameReader,
    lobes: Lobes,
    need: BytesPerTexel,
    memory: float | None,
    seed: int,
) -> _Told:
    means = means_without_lobes(
        run.part(lighting.name), lighting, reader, lobes, need, memory, seed
    )
    diffuse, in_own_light, error = _diffuse_of_means(lighting, means, lobes)
    # S is sharp, but may be wrong: what pictures show is told without it.
    diffuse, in_own_light = (
        _with_patterns(run.part(part), lighting, reader, lobes, shown, means, memory, seed)
        for part, shown in (
            (lighting.name, diffuse),
            (f"{lighting.name}:in-own-light", in_own_light),
        )
    )
    return _Told(diffuse, in_own_light, error)


def _reflection(lighting: Lighting, told: _Told, irradiance: Float) -> Reflection:
    before = lighting.before
    return Reflection(
        radiance=told.in_own_light,
        irradiance=irradiance,
        error=told.error,
        known=before.coverage.shown,
        emissive=before.emissive,
        bound=np.where(before.coverage.clipped, before.lit.min(axis=1), 0),
    )


def _with_hidden(base_color: Float, one: Reflection, sent: Float, beside: Bool) -> Float:
    """What texels send, (T, 3), with what they reflect where no frame looked or all clipped;
    beside (T,): see ``beside_seen``."""
    hidden = without_leaks(base_color * one.irradiance / np.pi, sent, beside)
    told = one.measured | one.emissive
    return np.where(told[:, None], sent, hidden)


def _diffuse_of_means(lighting: Lighting, found: RobustMean, lobes: Lobes) -> _Told:
    """What single texels tell of a lighting."""
    texels, before = lighting.lit.texels, lighting.before
    emissive, level = before.emissive, level_of(before.lit)
    known = np.isfinite(found.mean[:, 0]) & ~emissive
    # Too dark for a sample in any frame, or only glimpsed: there is nothing to take off.
    plain = before.coverage.tells_albedo & ~known & ~emissive
    clipped, metal = before.coverage.clipped, lobes.conducts[texels.object_index()] & ~emissive

    def restored_over(unit: Float, uneven: Float) -> Float:
        """Of what is measured in this ``unit`` (T, 3), of which pixels blurred nothing."""
        shown = np.where(plain[:, None], before.lit, np.maximum(found.mean * level[:, None], 0))
        shown = np.where(known[:, None], shown * uneven, shown) / unit
        variance = found.variance * (level / unit.mean(axis=1)) ** 2
        filled_in = inpaint(texels, np.asarray(shown, np.float32), known | plain)
        diffuse = unit * restored(texels, filled_in, known, variance, found.footprint)
        diffuse = np.where(emissive[:, None], before.emission, np.maximum(diffuse, 0))
        # What clips in every frame is at least as bright as that.
        diffuse = np.where(clipped[:, None], np.maximum(diffuse, before.lit), diffuse)
        diffuse[metal] = 0
        return np.asarray(diffuse, np.float32)

    one = np.ones_like(before.lit)
    mixed, in_own_light = restored_over(one, found.uneven), restored_over(light_of(before), one)
    relative = np.maximum(found.mean.mean(axis=1), 1e-3)
    error = np.where(known, np.sqrt(found.variance) / relative, np.inf)
    error[before.coverage.glimpsed] = 1  # as much of it may be something else's light
    return _Told(mixed, in_own_light, error.astype(np.float32))


def _with_patterns(
    run: TaskRun,
    lighting: Lighting,
    reader: FrameReader,
    lobes: Lobes,
    diffuse: Float,
    means: RobustMean,
    memory: float | None,
    seed: int,
) -> Float:
    """``diffuse`` (T, 3) of a lighting, with what the frames' pixels together tell beside it."""
    _, lit, before, own = lighting
    frames, texels, level2 = reader.frames, lit.texels, level_of(before.lit) ** 2
    # Read once: each frame asks for it.
    owner, samples = texels.object_index(), before.samples
    known = np.isfinite(means.mean[:, 0]) & ~before.emissive & ~lobes.conducts[owner]
    # Of a single sample, what it differs from the others by.
    variance = means.variance * level2 * np.minimum(samples, MOST_SAMPLES)
    told = np.stack([np.where(known, variance, 0), known], axis=-1).astype(np.float32)
    variance, share = around(texels, told, means.footprint).T
    variance = np.where(known, variance / np.maximum(share, 1e-6), 0).astype(np.float32)
    texel_of = np.full(len(texels.nearest_texel), -1, np.int32)
    texel_of[texels.pixel[known]] = np.flatnonzero(known)
    surface = PatternedSurface(lit.scene, lit.rays, texels, owner, diffuse, texel_of, variance)

    def steps_by(level: Float) -> dict[str, Array]:
        seen = _Patterned(surface, samples, level, reader, own, seed)

        def steps(part: slice) -> dict[str, Array]:
            if workers := run.elsewhere():
                shares, given = (
                    shares_of(part, workers),
                    seen._replace(reader=reader.among(workers)),
                )
                return among_workers(
                    run, "steps", shares, _pattern_of, given, shares, "fit: patterns"
                )
            frames, pixels = _pixels(seen, part)
            bar = progress(pixels, total=len(frames), label="fit: patterns", unit="frames")
            return steps_of(surface, bar, part, level, seed)

        return in_passes(run, "patterns", groups, steps)

    # Groups take what lies beside them along.
    beside = min(2 * ROWS_BESIDE * int(texels.resolution[:, 0].max()), len(texels))
    always = _OF_PATTERNS.always + _OF_PATTERNS.grouped * beside // len(texels)
    need = _OF_PATTERNS._replace(always=always)
    groups = texels_at_once(lit, frames.at(own), memory, need, warns=False)
    return with_patterns(surface, means.footprint, steps_by)


class _Patterned(NamedTuple):
    """What the frames ``own`` show of a surface; samples, level  (T,): how many measured each
    texel, and the radiance that contrasts are a share of."""

    surface: PatternedSurface
    samples: Float
    level: Float
    reader: FrameReader
    own: range
    seed: int


def _pixels(seen: _Patterned, part: slice) -> tuple[Sequence[int], Iterator[tuple[int, Covering]]]:
    """The frames whose pixels may tell of the texels of ``part``; and of each of them its number
    among all, and what these pixels tell."""
    surface, samples, _, reader, own, seed = seen
    frames, texels = reader.frames, surface.texels
    whole = with_rows_beside(texels, part, ROWS_BESIDE + REACH)
    looked_at = frames_in_view(texels, whole, frames, own)

    def of_frame(i: int) -> tuple[int, Covering]:
        picture, camera = Picture.of(reader.read(i)), frames.camera(i)
        noise = OF_NOISE_FLOOR * float(frames.noise_floor_radiance[i])
        found = pixels_of_frame(surface, picture, camera, noise, RELATIVE_ERROR, whole)
        return i - own.start, found.take(subsample(found.texel, samples[found.texel], i, seed))

    return looked_at, ahead(of_frame, looked_at)


def _pattern_of(seen: _Patterned, part: slice) -> Mapping[str, Array]:
    """A unit of work: what the frames tell of some texels."""
    _, pixels = _pixels(seen, part)
    return steps_of(seen.surface, pixels, part, seen.level, seen.seed)


def frame_reader(
    lightings: Sequence[LitScene], frames: Frames, memory: float | None
) -> FrameReader:
    """Keeps the frames for which refining leaves room in ``memory`` (GiB)."""
    lit = lightings[0]
    room = (
        bytes_for_frames(lit.texels, lit.scene, frames, memory, need)
        for need in (bytes_of_refining(lightings), _OF_PATTERNS)
    )
    return FrameReader(frames.images_alone(), min(room))
