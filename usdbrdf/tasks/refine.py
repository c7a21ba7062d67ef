"""L_d without the specular light that its frames hold, and the base colour that follows.

The median of the frames keeps the specular reflection that is seen from everywhere: by 2 to 130 %
it made albedos too large. With the lobes known it can be taken off every single sample, by ray
tracing. What is left are samples of one number with known errors: so their robust mean takes the
place of the median, and what the pixels blurred is restored where it stands above the noise.
"""

from __future__ import annotations

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.job.progress import progress, say
from usdbrdf.job.task import StageRun
from usdbrdf.model.arrays import Bool, Double, Float, Int
from usdbrdf.model.capture import Frames
from usdbrdf.model.texels import Texels
from usdbrdf.tasks.albedo_map import albedo_map
from usdbrdf.tasks.atlas import Atlas, TexelMap
from usdbrdf.tasks.in_passes import in_passes
from usdbrdf.tasks.refined_irradiance import Lobes, refined_irradiance
from usdbrdf.tasks.texture import CLIPPED, FILLED
from usdbrdf.texturing.footprints import footprints, restored, widest
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.texturing.observe import samples_from_frames, spread_order
from usdbrdf.texturing.passes import BytesPerTexel, groups_of_texels, smallest_groups
from usdbrdf.texturing.robust_mean import MeanState, RobustMean, robust_mean, update
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.warps import shifts_of

# Rays per sample: the mean over the frames averages their noise out, so a texel that many frames
# see needs fewer of each.
_RAYS, _MANY_FRAMES, _RAYS_OF_MANY = 8, 16, 4

# Of a texel that more frames see than this, so many are taken on the average, spread over all: what
# is left of their noise is far below the other errors.
_MOST_SAMPLES = 24

# Bytes that a texel takes: its state (132) and its place among the blocks of texels while these are
# sorted out; its mean; blurring and filling in, afterwards; and what it is lit by.
_OF_REFINING = BytesPerTexel(grouped=170, result=28, after=150, always=24)

# A sample's error, in parts of the texel's lit radiance: what poses, lobes and reading do to it;
# and in parts of the noise floor, which lies some four deviations of the sensor's noise above zero.
_RELATIVE_ERROR, _OF_NOISE_FLOOR = 0.03, 0.25

# Errors in proportion to what is seen: those of black surfaces are not below this share of the
# scene's median.
_DARKEST = 1e-3


def refined_maps(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    frames: Frames,
    lobes: Lobes,
    lightmap_filter: str,
    memory: float | None,
    seed: int,
) -> dict[str, TexelMap]:
    """The maps "diffuse", L_d without specular light; "refined_irradiance", S of that and of the
    lobes; and "base_color", pi L_d / S of these two.

    Where no frame measured a texel the base colour is filled in from its object's measured ones,
    and L_d is what it reflects of S; what shines keeps the radiance with which it shines.
    """
    texels = atlas.texels
    measured_lit = atlas.map("lit")
    level = _level(measured_lit)
    observed = _without_lobes(run, atlas, lit, frames, lobes, level, memory, seed)
    measured = np.isfinite(observed.mean[:, 0])
    emission = atlas.map_where_present("emission", 3)
    emissive: Bool = np.any(emission > 0, axis=1)
    known = measured & ~emissive
    diffuse = np.where(emissive[:, None], emission, _restored(texels, observed, known, level))
    del observed  # several times as large as a map
    # What clips in every frame is at least as bright as that.
    coverage = atlas.map("coverage")
    clipped = coverage == CLIPPED
    diffuse = np.where(clipped, np.maximum(diffuse, measured_lit), diffuse)
    seen = coverage[:, 0] != FILLED

    def reflected(radiance: Float, irradiance: Float) -> tuple[Float, Float]:
        """Base colour, and L_d with what it reflects where nobody looked."""
        base_color, _ = albedo_map(texels, radiance, irradiance, seen, emissive)
        filled = ~(seen | emissive)[:, None]
        return base_color, np.where(filled, base_color * irradiance / np.pi, radiance)

    _, diffuse = reflected(diffuse, atlas.map("irradiance"))
    irradiance = refined_irradiance(run, atlas, lit, diffuse, lobes, lightmap_filter, seed)
    base_color, diffuse = reflected(diffuse, irradiance)
    return {
        "diffuse": TexelMap(diffuse.astype(np.float32), 1.0, "W/(m^2 sr)", exact=True),
        "refined_irradiance": TexelMap(irradiance, 1 / np.pi, "W/m^2"),
        "base_color": TexelMap(base_color, 1.0, "1"),
    }


def _restored(texels: Texels, found: RobustMean, known: Bool, level: Float) -> Float:
    """(T, 3), W/(m^2 sr), from the means in units of ``level``; filled in where not ``known``."""
    filled = inpaint(texels, np.maximum(found.mean * level[:, None], 0), known)
    variance = found.variance * level**2
    return np.maximum(restored(texels, filled, known, variance, found.footprint), 0)


def _level(lit: Float) -> Float:
    """Of each texel, (T,), W/(m^2 sr): its lit radiance (T, 3), and no less than a little."""
    mean = lit.mean(axis=1)
    level: Float = np.maximum(mean, max(_DARKEST * float(np.median(mean)), 1e-30))
    return level


def _without_lobes(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    frames: Frames,
    lobes: Lobes,
    level: Float,
    memory: float | None,
    seed: int,
) -> RobustMean:
    """All frames without their specular light, in units of ``level`` (T,), in as many passes as
    memory asks for."""
    textures = _bytes_of(lit) // len(atlas.texels)
    need = _OF_REFINING._replace(always=_OF_REFINING.always + textures)
    try:
        groups = groups_of_texels(atlas.texels, atlas.scene, frames, memory, need)
    except EnvironmentFailure as short:  # after all that was done, rather too much than nothing
        say(f"warning: {short}")
        groups = smallest_groups(atlas.texels)
    samples = atlas.map("samples")[:, 0]

    def means(part: slice) -> dict[str, Float]:
        observed = _observe(run, atlas, lit, frames, lobes, level, samples, seed, part)
        return dict(vars(robust_mean(observed)))

    return RobustMean(**in_passes(run, "means", groups, len(atlas.texels), means))


def _bytes_of(lit: LitScene) -> int:
    """What the light takes beside scene and texels."""
    return lit.radiance.pixels.nbytes + lit.radiance.faces.nbytes + lit.emission.pixels.nbytes


def _observe(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    frames: Frames,
    lobes: Lobes,
    level: Float,
    samples: Float,
    seed: int,
    part: slice,
) -> MeanState:
    """Some texels in all frames, going on from the last saved state of an interrupted run; samples
    (T,): how many frames see each."""
    texels, owner = atlas.texels, atlas.texels.object_index()
    name = f"refined-{part.start}-{part.stop}"
    saved = run.latest(name)
    start, observed = 0, MeanState.empty(part.stop - part.start)
    if saved is not None:
        start, observed = saved[0] + 1, MeanState(**saved[1])
    # The mean starts from its first samples, which must not all show one highlight.
    order = spread_order(len(frames))[start:]
    shown = samples_from_frames(texels, atlas.scene, lit.rays, frames, order, part)
    bar = progress(shown, total=len(order), label="fit: refine", unit="frames")
    for done, some in enumerate(bar, start):
        taken = _taken(some.texel, samples[some.texel], some.frame, seed)
        texel, radiance = some.texel[taken], some.radiance[taken]
        camera = frames.camera(some.frame)
        specular = np.empty_like(radiance)
        often = samples[texel] >= _MANY_FRAMES
        for rays, which in ((_RAYS, ~often), (_RAYS_OF_MANY, often)):
            own = texel[which]
            specular[which] = lobe_radiance(
                lit, _seen_from(texels, own, camera.eye), lobes.phi[owner[own]],
                lobes.psi[owner[own]], rays, seed + len(frames) + some.frame, own.astype(np.int64),
            )  # fmt: skip
        unit, covered = level[texel], footprints(texels, texel, camera)
        deviation = _deviation(unit, covered, float(frames.noise_floor_radiance[some.frame]))
        values = (radiance - specular) / unit[:, None]
        update(observed, texel - np.int32(part.start), values, deviation, covered)
        run.save_latest_in_time(name, done, observed.arrays)
    return observed


def _deviation(unit: Float, covered: Float, noise_floor: float) -> Float:
    """Of the errors of samples, (M,), in units of their texels' ``unit``, with footprints
    ``covered`` (M, 3)."""
    noise = np.float32(_OF_NOISE_FLOOR * noise_floor) / unit
    # A wide view of a texel says less of it than its noise tells.
    wide = np.maximum(widest(covered) ** 2 + 0.5, 1) ** 0.25
    return np.asarray(np.hypot(_RELATIVE_ERROR, noise) * wide, np.float32)


def _taken(texel: Int, samples: Float, frame: int, seed: int) -> Bool:
    """Which of the texels (M,), which so many frames show as ``samples`` (M,) says, are taken from
    this frame: what becomes of a texel depends on nothing but its number."""
    taken: Bool = samples <= _MOST_SAMPLES
    many = np.flatnonzero(~taken)
    chance = shifts_of(texel[many].astype(np.int64), 1, seed + frame)[:, 0]
    taken[many] = chance * samples[many] < _MOST_SAMPLES
    return taken


def _seen_from(texels: Texels, which: Int, eye: Double) -> SurfacePoints:
    """Texels as surface points that a camera at ``eye`` sees."""
    position = texels.position[which]
    to_camera = (eye - position).astype(np.float32)
    to_camera /= np.maximum(np.linalg.norm(to_camera, axis=1, keepdims=True), 1e-12)
    barycentric = texels.barycentric[which]
    return SurfacePoints(
        face=texels.face[which],
        u=barycentric[:, 1],
        v=barycentric[:, 2],
        position=position,
        normal=texels.normal[which],
        to_camera=to_camera,
    )
