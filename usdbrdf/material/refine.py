"""L_d without the specular light that its frames hold, and the base colour that follows.

The median of the frames keeps the specular reflection that is seen from everywhere: by 2 to 130 %
it made albedos too large. With the lobes known it can be taken off every single sample, by ray
tracing. What is left are samples of one number with known errors: so their robust mean takes the
place of the median, and what the pixels blurred is restored where it stands above the noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from usdbrdf import calibration
from usdbrdf.ahead import ahead
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.frames import FrameReader
from usdbrdf.job.progress import progress, warn
from usdbrdf.job.task import TaskRun
from usdbrdf.material.refined_irradiance import Lobes, let_through_surfaces, refined_irradiance
from usdbrdf.material.sample_specular import TILE_SIDE, specular_of_samples
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.shading.base_color import Reflection, base_color_of
from usdbrdf.shading.hidden_light import beside_seen, without_leaks
from usdbrdf.texturing.footprints import around, footprints, restored, widest
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.texturing.light_on_pixels import beside_own_light
from usdbrdf.texturing.observe import frames_in_view, samples_from_frames, spread_order
from usdbrdf.texturing.passes import (
    BytesPerTexel,
    among_workers,
    bytes_for_frames,
    groups_of_texels,
    in_passes,
    shares_of,
    smallest_groups,
    with_rows_beside,
)
from usdbrdf.texturing.pattern_pixels import REACH, Covering, PatternedSurface, pixels_of_frame
from usdbrdf.texturing.patterns import BYTES_OF_EQUATIONS, ROWS_BESIDE, steps_of, with_patterns
from usdbrdf.texturing.robust_mean import MeanState, RobustMean, robust_mean, update
from usdbrdf.texturing.samples import MIN_COSINE, Picture
from usdbrdf.transport.brdf import DIELECTRIC, F0_OF_PSI
from usdbrdf.transport.denoise import OIDN
from usdbrdf.transport.let_through import share_let_through, share_seen
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.surface_texture import SurfaceTexture
from usdbrdf.transport.warps import shifts_of

# Of a texel that more frames see than this, so many are taken on the average, spread over all: what
# is left of their noise is far below the other errors.
_MOST_SAMPLES = 24
# Bytes that a texel takes: its state (144), its place among the blocks of texels while these are
# sorted out, and what the next frames show of it; its mean; blurring and filling in, afterwards;
# and what it is lit by, with and without what its surface keeps.
_OF_REFINING = BytesPerTexel(grouped=202, result=40, after=218, always=24, pixel=240)
_OF_PATTERNS = BytesPerTexel(grouped=BYTES_OF_EQUATIONS, result=28, after=60, always=44, pixel=450)
RELATIVE_ERROR = calibration.number("refine.relative_error")
_OF_LOBE = calibration.number("refine.of_lobe")
OF_NOISE_FLOOR = calibration.number("refine.noise_of_floor")
_DARKEST = calibration.number("refine.darkest")


class LightBefore(Protocol):
    """What texturing and shading know of T texels; each is read when it is needed.

    lit         (T, 3) W/(m^2 sr): L_d with the specular light in it
    light       (T, 3) W/(m^2 sr): what S is of: the same with what shines and what hidden surfaces
                reflect
    samples     (T,): how many frames measured each texel
    emission    (T, 3) W/(m^2 sr): what shines by itself, zero elsewhere; emissive (T,): it does
    irradiance  (T, 3) W/m^2: S with ``light`` as the light; traced_irradiance: before the lightmap
                filter, where there was one
    irradiance_error  (T,): standard deviation of S by its rays, relative to it; asked for where
                several lightings are weighed
    """

    @property
    def lit(self) -> Float: ...
    @property
    def light(self) -> Float: ...
    @property
    def samples(self) -> Float: ...
    @property
    def coverage(self) -> CoverageMap: ...
    @property
    def emission(self) -> Float: ...
    @property
    def emissive(self) -> Bool: ...
    @property
    def irradiance(self) -> Float: ...
    @property
    def traced_irradiance(self) -> Float: ...
    @property
    def irradiance_error(self) -> Float: ...


class Lighting(NamedTuple):
    """A scene in one light, what is known of it before, and its frames among all that are read;
    name: "" for the only one."""

    name: str
    lit: LitScene
    before: LightBefore
    own: range


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
    need = _need([one.lit for one in lightings])
    texels, found = lightings[0].lit.texels, []
    owner = texels.object_index()
    metal = lobes.conducts[owner]
    bounds = []
    for one in lightings:
        means = _means_without_lobes(run.part(one.name), one, reader, lobes, need, memory, seed)
        diffuse, in_own_light, error = _diffuse_of_means(one, means, lobes)
        # S is sharp, but may be wrong: what pictures show is told without it.
        diffuse, in_own_light = (
            _with_patterns(run.part(part), one, reader, lobes, shown, means, memory, seed)
            for part, shown in ((one.name, diffuse), (f"{one.name}:in-own-light", in_own_light))
        )
        bounds.append(np.where(one.before.coverage.clipped, one.before.lit.min(axis=1), 0))
        if len(lightings) > 1:
            error = np.hypot(error, one.before.irradiance_error)
        found.append((diffuse, in_own_light, error))
    besides = [
        beside_seen(texels, one.before.coverage.observed | one.before.emissive) for one in lightings
    ]

    def reflected(irradiance: Sequence[Float]) -> tuple[Float, list[Float]]:
        """Base colour, and of each lighting L_d with what it reflects where nobody looked or all
        frames clipped."""
        shown = [
            Reflection(
                radiance=in_own_light,
                irradiance=incoming,
                error=error,
                known=one.before.coverage.observed,
                emissive=one.before.emissive,
                bound=bound,
            )
            for one, (_, in_own_light, error), bound, incoming in zip(
                lightings, found, bounds, irradiance, strict=True
            )
        ]
        base_color = base_color_of(texels, shown)
        light = []
        for one, (diffuse, *_), beside in zip(shown, found, besides, strict=True):
            hidden = base_color * one.irradiance / np.pi
            hidden = without_leaks(hidden, diffuse, beside)
            told = one.measured | one.emissive
            light.append(np.where(told[:, None], diffuse, hidden))
        return base_color, light

    _, first = reflected([one.before.irradiance for one in lightings])
    irradiance, seen = [], np.ones((len(texels), 1), np.float32)
    if lightings[0].lit.lobe == DIELECTRIC:
        seen[~metal] = share_seen(lobes.phi, lobes.psi)[owner[~metal], None]
    for (name, lit, before, _), diffuse in zip(lightings, first, strict=True):
        change = np.where(before.emissive[:, None], 0, diffuse - before.light).astype(np.float32)
        traced = before.traced_irradiance if lightmap_filter == OIDN else before.irradiance
        own = run.part(name)
        refined = refined_irradiance(own, lit, traced, change, lobes, lightmap_filter, seed)
        light = np.where(before.emissive[:, None], before.emission, diffuse).astype(np.float32)
        refined = refined + let_through_surfaces(own, lit, light, lobes, seed)
        irradiance.append(np.asarray(np.maximum(refined, 0) / seen, np.float32))
    found = [(diffuse, own, error) for diffuse, (_, own, error) in zip(first, found, strict=True)]
    base_color, shown = reflected(irradiance)
    reflects = metal & ~np.all([one.before.emissive for one in lightings], axis=0)
    base_color[reflects] = F0_OF_PSI * lobes.psi[owner[reflects]]
    return [
        Refined(diffuse=own.astype(np.float32), irradiance=incoming, base_color=base_color)
        for own, incoming in zip(shown, irradiance, strict=True)
    ]


def _diffuse_of_means(
    lighting: Lighting, found: RobustMean, lobes: Lobes
) -> tuple[Float, Float, Float]:
    """L_d (T, 3) of a lighting without its specular light, as pixels mix it; the same of each texel
    in its own light, of which it tells the albedo, see ``light_on_pixels``; and the standard
    deviation (T,) relative to it, infinite where no frame measured it."""
    texels, before = lighting.lit.texels, lighting.before
    emissive, level = before.emissive, _level(before.lit)
    known = np.isfinite(found.mean[:, 0]) & ~emissive
    # Too dark for a sample in any frame: there is nothing to take off.
    dark = before.coverage.measured & ~known & ~emissive
    clipped, metal = before.coverage.clipped, lobes.conducts[texels.object_index()] & ~emissive

    def restored_over(unit: Float, uneven: Float) -> Float:
        """Of what is measured in this ``unit`` (T, 3), of which pixels blurred nothing."""
        shown = np.where(dark[:, None], before.lit, np.maximum(found.mean * level[:, None], 0))
        shown = np.where(known[:, None], shown * uneven, shown) / unit
        variance = found.variance * (level / unit.mean(axis=1)) ** 2
        filled_in = inpaint(texels, np.asarray(shown, np.float32), known | dark)
        diffuse = unit * restored(texels, filled_in, known, variance, found.footprint)
        diffuse = np.where(emissive[:, None], before.emission, np.maximum(diffuse, 0))
        # What clips in every frame is at least as bright as that.
        diffuse = np.where(clipped[:, None], np.maximum(diffuse, before.lit), diffuse)
        diffuse[metal] = 0
        return np.asarray(diffuse, np.float32)

    one = np.ones_like(before.lit)
    mixed, in_own_light = restored_over(one, found.uneven), restored_over(_light(before), one)
    relative = np.maximum(found.mean.mean(axis=1), 1e-3)
    error = np.where(known, np.sqrt(found.variance) / relative, np.inf)
    return mixed, in_own_light, error.astype(np.float32)


def _light(before: LightBefore) -> Float:
    """(T, 3): S of each texel, W/m^2, and no less than a little; 1 where there is none at all."""
    light = before.irradiance
    least = _DARKEST * float(np.median(light.mean(axis=1)))
    return np.asarray(np.maximum(light, least) if least > 0 else np.ones_like(light), np.float32)


def _level(lit: Float) -> Float:
    """Of each texel, (T,), W/(m^2 sr): its lit radiance (T, 3), and no less than a little."""
    mean = lit.mean(axis=1)
    level: Float = np.maximum(mean, max(_DARKEST * float(np.median(mean)), 1e-30))
    return level


def _means_without_lobes(
    run: TaskRun,
    lighting: Lighting,
    reader: FrameReader,
    lobes: Lobes,
    need: BytesPerTexel,
    memory: float | None,
    seed: int,
) -> RobustMean:
    """Of T texels the mean over a lighting's frames without their specular light, relative to
    ``_level`` of their lit radiance, in as many passes over the frames as ``memory`` (GiB) asks
    for."""
    _, lit, before, own = lighting
    light = lit.radiance.showing(lit.texels, _light(before))
    shown = _Shown(lit, before.samples, lobes, _level(before.lit), light, reader, own, seed)

    def means(part: slice) -> dict[str, Array]:
        """Of some texels, going on from the last saved state of an interrupted run."""
        name = f"refined-{part.start}-{part.stop}"
        saved = run.latest(name)
        start, observed = 0, MeanState.empty(part.stop - part.start)
        if saved is not None:
            start, observed = saved[0] + 1, MeanState(**saved[1])
        if workers := run.elsewhere():
            shares = shares_of(part, workers)
            pieces = [
                (one, start, [v[one.start - part.start : one.stop - part.start] for v in observed])
                for one in shares
            ]
            given = shown._replace(reader=reader.among(workers))
            name = f"{name}-from-{start}"
            return among_workers(run, name, shares, _means_of, given, pieces, "fit: refine")
        frames_left = _with_frames(shown, part, start, observed)
        total = len(own) - start
        for done in progress(frames_left, total=total, label="fit: refine", unit="frames"):
            run.save_latest_in_time(name, done, observed._asdict)
        return robust_mean(observed)._asdict()

    groups = _groups(lit, reader.frames.at(own), memory, need)
    return RobustMean(**in_passes(run, "means", groups, means))


class _Shown(NamedTuple):
    """What the frames ``own`` of a lighting show: a scene with lobes, how many measured each texel,
    (T,), the radiance that its samples are relative to, (T,), and S as a texture."""

    lit: LitScene
    samples: Float
    lobes: Lobes
    level: Float
    light: SurfaceTexture
    reader: FrameReader
    own: range
    seed: int


def _with_frames(shown: _Shown, part: slice, start: int, observed: MeanState) -> Iterator[int]:
    """Add the frames from the place ``start`` on in their order to what was observed of the texels
    of ``part``, and give the place of each that is in it."""
    lit, samples, lobes, level, light, reader, own, seed = shown
    frames, texels = reader.frames, lit.texels
    owner = texels.object_index()
    # The mean starts from its first samples, which must not all show one highlight.
    order = [own.start + i for i in spread_order(len(own))[start:]]
    whole = with_rows_beside(texels, part, TILE_SIDE)
    sampled = samples_from_frames(lit, frames, reader.read, order, whole)
    for done, some in enumerate(sampled, start):
        taken = _subsample(some.texel, samples[some.texel], some.frame, seed)
        texel, camera = some.texel[taken], frames.camera(some.frame)
        of_texel = lobes.take(owner[texel])
        own_seed = seed + len(frames) + some.frame
        specular = specular_of_samples(
            lit, of_texel.phi, of_texel.psi, texel, samples[texel], camera.eye, own_seed
        )
        within = (texel >= part.start) & (texel < part.stop)
        covered = footprints(texels, texel, camera)
        unit = level[texel] * _let_through(lit, of_texel, texel, camera.eye)
        noise = np.float32(OF_NOISE_FLOOR * frames.noise_floor_radiance[some.frame]) / unit
        of_lobe = _OF_LOBE * np.abs(specular).mean(axis=1) / unit
        # A wide view of a texel says less of it than its noise tells.
        wide = np.maximum(widest(covered) ** 2 + 0.5, 1) ** 0.25
        error = np.sqrt(RELATIVE_ERROR**2 + noise**2 + of_lobe**2)
        deviation = np.asarray(error * wide, np.float32)
        uneven = beside_own_light(lit, owner, light, texel, camera)
        values = (some.radiance[taken] - specular) / (unit[:, None] * uneven)
        # What makes a sample brighter makes its errors larger.
        deviation /= np.minimum(uneven.mean(axis=1), 1)
        own_texel = texel[within] - np.int32(part.start)
        update(
            observed, own_texel, values[within], deviation[within], covered[within], uneven[within]
        )
        yield done


def _means_of(shown: _Shown, piece: tuple[slice, int, list[Array]]) -> Mapping[str, Array]:
    """A unit of work: the means of some texels, from a frame on after earlier ones."""
    part, start, earlier = piece
    observed = MeanState._make(values.copy() for values in earlier)
    for _ in _with_frames(shown, part, start, observed):
        pass
    return robust_mean(observed)._asdict()


def _groups(
    lit: LitScene, frames: Frames, memory: float | None, need: BytesPerTexel, *, warns: bool = True
) -> list[slice]:
    try:
        return groups_of_texels(lit.texels, lit.scene, frames, memory, need)
    except EnvironmentFailure as short:  # after all that was done, rather too much than nothing
        if warns:
            warn(str(short))
        return smallest_groups(lit.texels)


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
    frames, texels, level2 = reader.frames, lit.texels, _level(before.lit) ** 2
    # Read once: each frame asks for it.
    owner, samples = texels.object_index(), before.samples
    known = np.isfinite(means.mean[:, 0]) & ~before.emissive & ~lobes.conducts[owner]
    # Of a single sample, what it differs from the others by.
    variance = means.variance * level2 * np.minimum(samples, _MOST_SAMPLES)
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
    groups = _groups(lit, frames.at(own), memory, need, warns=False)
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
        return i - own.start, found.take(_subsample(found.texel, samples[found.texel], i, seed))

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
        for need in (_need(lightings), _OF_PATTERNS)
    )
    return FrameReader(frames.images_alone(), min(room))


def _need(lightings: Sequence[LitScene]) -> BytesPerTexel:
    """With the light, which lies beside scene and texels; of each lighting its own."""
    light = sum(
        lit.radiance.pixels.nbytes + lit.radiance.faces.nbytes + lit.emission.pixels.nbytes
        for lit in lightings
    )
    light += lightings[0].radiance.pixels.nbytes  # S as a texture, of one at a time
    always = len(lightings) * _OF_REFINING.always + light // len(lightings[0].texels)
    return _OF_REFINING._replace(always=always)


def _subsample(texel: Int, samples: Float, frame: int, seed: int) -> Bool:
    """Which of the texels (M,), which so many frames show as ``samples`` (M,) says, are taken from
    this frame: what becomes of a texel depends on nothing but its number."""
    taken: Bool = samples <= _MOST_SAMPLES
    many = np.flatnonzero(~taken)
    chance = shifts_of(texel[many].astype(np.int64), 1, seed + frame)[:, 0]
    taken[many] = chance * samples[many] < _MOST_SAMPLES
    return taken


def _let_through(lit: LitScene, lobes: Lobes, texel: Int, eye: Double) -> Float:
    """By how much the diffuse part of texels (M,), each with a lobe of its own, is brighter towards
    ``eye`` than on the mean; see ``share_let_through``."""
    if lit.lobe != DIELECTRIC:
        return np.ones(len(texel), np.float32)
    to_eye = eye - lit.texels.position[texel]
    cosine = (lit.texels.normal[texel] * to_eye).sum(axis=1) / np.linalg.norm(to_eye, axis=1)
    # Samples have been taken where the face is not seen at a lower angle; its normals may be.
    cosine = np.maximum(cosine, MIN_COSINE)
    return np.where(lobes.conducts, 1, share_let_through(lobes.phi, lobes.psi, cosine))
