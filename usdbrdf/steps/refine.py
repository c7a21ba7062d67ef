"""L_d without the specular light that its frames hold, and the base colour that follows.

The median of the frames keeps the specular reflection that is seen from everywhere: by 2 to 130 %
it made albedos too large. With the lobes known it can be taken off every single sample, by ray
tracing; the same streaming median then runs over what is left.
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
from usdbrdf.texturing import psquare
from usdbrdf.texturing.inpaint import inpaint
from usdbrdf.texturing.radiance_from_frames import Observation, radiance_from_frames

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Int = npt.NDArray[np.int32]
Bool = npt.NDArray[np.bool_]

# Rays per texel and frame: the median over the frames averages their noise out.
_RAYS = 16
# Whatever quantile the lit map has: highlights are gone, so the median is the diffuse radiance.
_QUANTILE = 0.5


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
    observed = _observe(run, atlas, lit, frames, lobes, seed)
    measured = observed.quantiles.count > 0
    emission = atlas.map_where_present("emission", 3)
    emissive: Bool = np.any(emission > 0, axis=1)
    known = measured & ~emissive
    diffuse = np.maximum(psquare.quantile(observed.quantiles, _QUANTILE), 0)
    diffuse = np.where(emissive[:, None], emission, inpaint(texels, diffuse, known))
    # What clips in every frame is at least as bright as that.
    coverage = atlas.map("coverage")
    clipped = coverage == CLIPPED
    diffuse = np.where(clipped, np.maximum(diffuse, atlas.map("lit")), diffuse)
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


def _observe(
    run: StageRun,
    atlas: Atlas,
    lit: LitScene,
    frames: Frames,
    lobes: Lobes,
    seed: int,
) -> Observation:
    """All frames, going on from the last saved state of an interrupted run."""
    texels, owner = atlas.texels, atlas.texels.object_index()
    saved = run.latest("refined")
    start, observed = 0, Observation.empty(len(texels))
    if saved is not None:
        start, observed = saved[0] + 1, Observation.from_arrays(saved[1])

    def specular(frame: int, which: Int) -> Float:
        points = _seen_from(texels, which, frames.world_from_camera[frame][:3, 3])
        own = owner[which]
        number = seed + len(frames) + frame
        return non_diffuse_radiance(lit, points, lobes.phi[own], lobes.psi[own], _RAYS, number)

    steps = radiance_from_frames(
        texels, atlas.scene, lit.rays, frames, observed, _QUANTILE, start, specular
    )
    for done in progress(steps, total=len(frames) - start, label="fit: refine", unit="frames"):
        if done % 16 == 15:
            run.save_latest("refined", done, observed.arrays())
    return observed


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
