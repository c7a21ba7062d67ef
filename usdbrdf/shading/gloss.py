"""What surfaces would mirror if all were usual dielectrics: of what kind they are nobody knows
before lobes are fitted, but next to what dark ones scatter it is much.

Varnish, plastics and glaze let F0 = 0.04 back at their surface, and hardly any is smoother than
shown here or much rougher; how much of it a scene does is for the light to tell, ``outside_light``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from usdbrdf import calibration
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.agreement import MeshPoints, seen_points
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.environment import Environment, black_environment
from usdbrdf.transport.lit_scene import LitScene, TexturedScene, lit_scene, points_of_texels
from usdbrdf.transport.lobe_radiance import lobe_radiance, specular_irradiance
from usdbrdf.transport.warps import shifts_of

_PHI, _PSI = calibration.pair("gloss.usual")
# Frames at most that a texel is looked at from, and rays from each; rays that look around from a
# texel, and from where each of them ends.
_VIEWS, _RAYS_OF_VIEW = 8, 32
_RAYS, _RAYS_OF_LOBE = 64, 4


def mirrored_to_frames(
    surface: TexturedScene,
    light: Float,
    outside: Environment,
    frames: Frames,
    index: Long,
    seed: int,
) -> Double:
    """(N, 3) W/(m^2 sr): what texels ``index`` (N,) would mirror of the radiance ``light`` (T, 3)
    and of what is outside to the frames that see them, the median of some of these; 0 where none
    does."""
    lit, texels = _of_dielectrics(surface, light, outside), surface.texels
    eyes = np.stack([frames.camera(i).eye for i in range(len(frames))])
    shown = np.full((_VIEWS, len(index), 3), np.nan, np.float32)
    for row, frame in zip(shown, _some_that_see(surface, frames, index, seed).T, strict=True):
        which = np.flatnonzero(frame >= 0)
        own = index[which]
        points = points_of_texels(texels, own, eyes[frame[which]])
        phi, psi = (np.full(len(own), value, np.float32) for value in (_PHI, _PSI))
        row[which] = lobe_radiance(lit, points, phi, psi, _RAYS_OF_VIEW, seed, own)
        seed += 1
    seen = np.isfinite(shown[:, :, 0]).any(axis=0)
    found = np.zeros((len(index), 3))
    found[seen] = np.nanmedian(shown[:, seen], axis=0)
    return found


def mirrored_irradiance(surface: TexturedScene, light: Float, index: Long, seed: int) -> Double:
    """(N, 3) W/m^2: what texels ``index`` (N,) would receive of the radiance ``light`` (T, 3) by
    way of one mirroring surface."""
    texels, count = surface.texels, len(surface.scene.objects)
    lit = _of_dielectrics(surface, light, black_environment())
    found = specular_irradiance(
        lit, texels.position[index], texels.normal[index], index,
        np.full(count, _PHI, np.float32), np.full((count, 3), _PSI, np.float32),
        rays=_RAYS, rays_of_lobe=_RAYS_OF_LOBE, seed=seed,
    )  # fmt: skip
    return found.astype(np.float64)


def _of_dielectrics(surface: TexturedScene, light: Float, outside: Environment) -> LitScene:
    shines = np.zeros(len(surface.texels), np.bool_)
    return replace(lit_scene(surface, light, shines, outside), lobe=DIELECTRIC)


def _some_that_see(surface: TexturedScene, frames: Frames, index: Long, seed: int) -> Int:
    """(N, _VIEWS): frames that see texels ``index`` (N,), drawn from all that do; -1 for none. What
    a texel gets depends on nothing but its number."""
    texels, count = surface.texels, len(index)
    position, normal = texels.position[index], texels.geometric_normal[index]
    owner = texels.object_index()[index]
    points = MeshPoints(position.astype(np.float64), normal.astype(np.float64), owner)
    # The lowest numbers win; one that does not see the texel has none.
    best, frame = np.full((count, _VIEWS), np.inf), np.full((count, _VIEWS), -1, np.int32)
    for i in range(len(frames)):
        seen = seen_points(points, surface.rays, frames.camera(i))[0]
        drawn = np.where(seen, shifts_of(index, 1, seed + i)[:, 0], np.inf)
        last = best.argmax(axis=1)
        better = np.flatnonzero(drawn < np.take_along_axis(best, last[:, None], axis=1)[:, 0])
        best[better, last[better]], frame[better, last[better]] = drawn[better], i
    return frame
