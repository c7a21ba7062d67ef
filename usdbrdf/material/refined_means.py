"""What single texels show without the specular light that their frames hold.

With the lobes known it can be taken off every single sample, by ray tracing. What is left are
samples of one number with known errors: so their robust mean takes the place of the median."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from usdbrdf import calibration
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.frames import FrameReader
from usdbrdf.job.progress import progress, warn
from usdbrdf.job.task import TaskRun
from usdbrdf.material.refined_irradiance import Lobes
from usdbrdf.material.sample_specular import TILE_SIDE, specular_of_samples
from usdbrdf.model.arrays import Array, Bool, Double, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import CoverageMap
from usdbrdf.texturing.footprints import footprints, widest
from usdbrdf.texturing.light_on_pixels import beside_own_light
from usdbrdf.texturing.observe import samples_from_frames, spread_order
from usdbrdf.texturing.passes import (
    BytesPerTexel,
    among_workers,
    groups_of_texels,
    in_passes,
    shares_of,
    smallest_groups,
    with_rows_beside,
)
from usdbrdf.texturing.robust_mean import MeanState, RobustMean, robust_mean, update
from usdbrdf.texturing.samples import MIN_COSINE
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.let_through import share_let_through
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.surface_texture import SurfaceTexture
from usdbrdf.transport.warps import shifts_of

# Of a texel that more frames see than this, so many are taken on the average, spread over all: what
# is left of their noise is far below the other errors.
MOST_SAMPLES = 24
# Bytes that a texel takes: its state (144), its place among the blocks of texels while these are
# sorted out, and what the next frames show of it; its mean; blurring and filling in, afterwards;
# and what it is lit by, with and without what its surface keeps.
_OF_REFINING = BytesPerTexel(grouped=202, result=40, after=218, always=24, pixel=240)
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


def means_without_lobes(
    run: TaskRun,
    lighting: Lighting,
    reader: FrameReader,
    lobes: Lobes,
    need: BytesPerTexel,
    memory: float | None,
    seed: int,
) -> RobustMean:
    """Of T texels the mean over a lighting's frames without their specular light, relative to
    ``level_of`` of their lit radiance, in as many passes over the frames as ``memory`` (GiB) asks
    for."""
    _, lit, before, own = lighting
    light = lit.radiance.showing(lit.texels, light_of(before))
    shown = _Shown(lit, before.samples, lobes, level_of(before.lit), light, reader, own, seed)

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

    groups = texels_at_once(lit, reader.frames.at(own), memory, need)
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
        taken = subsample(some.texel, samples[some.texel], some.frame, seed)
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


def texels_at_once(
    lit: LitScene, frames: Frames, memory: float | None, need: BytesPerTexel, *, warns: bool = True
) -> list[slice]:
    """Groups of texels for which ``memory`` (GiB) has room beside the frames, of which each texel
    needs so many bytes; the smallest there are where it has not, of which ``warns`` tells."""
    try:
        return groups_of_texels(lit.texels, lit.scene, frames, memory, need)
    except EnvironmentFailure as short:  # after all that was done, rather too much than nothing
        if warns:
            warn(str(short))
        return smallest_groups(lit.texels)


def bytes_of_refining(lightings: Sequence[LitScene]) -> BytesPerTexel:
    """What ``means_without_lobes`` takes of a texel, with the light, which lies beside scene and
    texels; of each lighting its own."""
    light = sum(
        lit.radiance.pixels.nbytes + lit.radiance.faces.nbytes + lit.emission.pixels.nbytes
        for lit in lightings
    )
    light += lightings[0].radiance.pixels.nbytes  # S as a texture, of one at a time
    always = len(lightings) * _OF_REFINING.always + light // len(lightings[0].texels)
    return _OF_REFINING._replace(always=always)


def light_of(before: LightBefore) -> Float:
    """(T, 3): S of each texel, W/m^2, and no less than a little; 1 where there is none at all."""
    light = before.irradiance
    least = _DARKEST * float(np.median(light.mean(axis=1)))
    return np.asarray(np.maximum(light, least) if least > 0 else np.ones_like(light), np.float32)


def level_of(lit: Float) -> Float:
    """Of each texel, (T,), W/(m^2 sr): its lit radiance (T, 3), and no less than a little."""
    mean = lit.mean(axis=1)
    level: Float = np.maximum(mean, max(_DARKEST * float(np.median(mean)), 1e-30))
    return level


def subsample(texel: Int, samples: Float, frame: int, seed: int) -> Bool:
    """Which of the texels (M,), which so many frames show as ``samples`` (M,) says, are taken from
    this frame: what becomes of a texel depends on nothing but its number."""
    taken: Bool = samples <= MOST_SAMPLES
    many = np.flatnonzero(~taken)
    chance = shifts_of(texel[many].astype(np.int64), 1, seed + frame)[:, 0]
    taken[many] = chance * samples[many] < MOST_SAMPLES
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
