"""L_d without the specular light that its frames hold, and the base colour that follows.

The median of the frames keeps the specular reflection that is seen from everywhere: by 2 to 130 %
it made albedos too large. With the lobes known it can be taken off every single sample, by ray
tracing. What is left are samples of one number with known errors: so their robust mean takes the
place of the median, and what the pixels blurred is restored where it stands above the noise.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from usdbrdf.geometry.texels import Texels
from usdbrdf.job.progress import progress
from usdbrdf.job.stage import StageRun
from usdbrdf.material.lit_scene import LitScene
from usdbrdf.material.predict import non_diffuse_radiance
from usdbrdf.material.target_frames import SurfacePoints
from usdbrdf.scan.scan import Frames
from usdbrdf.steps.albedo_map import albedo_map
from usdbrdf.steps.atlas import Atlas, TexelMap
from usdbrdf.steps.refined_irradiance import Lobes, refined_irradiance
from usdbrdf.steps.texture import CLIPPED, FILLED
from usdbrdf.texturing.footprints import footprints, widest
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.texturing.radiance_from_frames import samples_from_frames, spread_order
from usdbrdf.texturing.restore import restored
from usdbrdf.texturing.robust_mean import MeanState, RobustMean, robust_mean, update

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]

# Rays per texel and frame: the mean over the frames averages their noise out.
_RAYS = 8
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
    observed = _observe(run, atlas, lit, frames, lobes, level, seed)
    measured = np.isfinite(observed.mean[:, 0])
    emission = atlas.map_where_present("emission", 3)
    emissive: Bool = np.any(emission > 0, axis=1)
    known = measured & ~emissive
    diffuse = np.where(emissive[:, None], emission, _restored(texels, observed, known, level))
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


def _observe(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    frames: Frames,
    lobes: Lobes,
    level: Float,
    seed: int,
) -> RobustMean:
    """All frames without their specular light, in units of ``level`` (T,), going on from the last
    saved state of an interrupted run."""
    texels, owner = atlas.texels, atlas.texels.object_index()
    saved = run.latest("refined")
    start, observed = 0, MeanState.empty(len(texels))
    if saved is not None:
        start, observed = saved[0] + 1, MeanState(**saved[1])
    # The mean starts from its first samples, which must not all show one highlight.
    order = spread_order(len(frames))[start:]
    samples = samples_from_frames(texels, atlas.scene, lit.rays, frames, order)
    bar = progress(samples, total=len(order), label="fit: refine", unit="frames")
    for done, some in enumerate(bar, start):
        pose, lens = frames.world_from_camera[some.frame], frames.intrinsics[some.frame]
        own, unit = owner[some.texel], level[some.texel]
        specular = non_diffuse_radiance(
            lit, _seen_from(texels, some.texel, pose[:3, 3]), lobes.phi[own], lobes.psi[own], _RAYS,
            seed + len(frames) + some.frame,
        )  # fmt: skip
        covered = footprints(texels, some.texel, pose, lens)
        noise = _OF_NOISE_FLOOR * np.float32(frames.noise_floor_radiance[some.frame]) / unit
        # A wide view of a texel says less of it than its noise tells.
        wide = np.maximum(widest(covered) ** 2 + 0.5, 1) ** 0.25
        deviation = np.hypot(_RELATIVE_ERROR, noise) * wide
        update(
            observed,
            some.texel,
            (some.radiance - specular) / unit[:, None],
            deviation.astype(np.float32),
            covered,
        )
        if done % 16 == 15:
            run.save_latest("refined", done, observed.arrays())
    return robust_mean(observed)


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
