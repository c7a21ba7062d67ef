"""What surfaces would mirror if all were usual dielectrics: of what kind they are nobody knows
before lobes are fitted, but next to what dark ones scatter it is much.

Varnish, plastics and glaze let F0 = 0.04 back at their surface, and hardly any is smoother than
shown here or much rougher; how much of it a scene does is for the light to tell, ``outside_light``,
and how much of it an object does for its views: what a texel mirrors is another light in each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import numpy.typing as npt

from usdbrdf import calibration
from usdbrdf.files.frames import read_frame, read_frames
from usdbrdf.model.arrays import Double, Float, Int, Long
from usdbrdf.model.capture import Frames
from usdbrdf.texturing.agreement import MeshPoints, seen_points
from usdbrdf.texturing.observe import spread_order
from usdbrdf.texturing.samples import (
    CLIPPED,
    NOTHING,
    SAMPLE,
    Picture,
    first_surfaces,
    samples_from_frame,
)
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
# How glossy objects are is looked for in so many frames, by texels that so many of them show; of
# fewer frames errors that agree in each are not known.
_FRAMES_OF_GLOSS, _FEWEST_VIEWS, _FEWEST_FRAMES, _STEPS = 64, 3, 4, 12
_SPREAD = calibration.number("gloss.spread")
_MOST = calibration.number("gloss.most")
_FREEDOM = calibration.number("gloss.student_freedom")
_LEAST_SCATTER, _TINY = 1e-3, 1e-12


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
    views = _some_that_see(surface, frames, index, range(len(frames)), seed)
    shown = _mirrored_to(surface, light, outside, frames, index, views, seed)
    seen = np.isfinite(shown[:, :, 0]).any(axis=0)
    found = np.zeros((len(index), 3))
    found[seen] = np.nanmedian(shown[:, seen], axis=0)
    return found


# Of an environment and texels (N,): pi times what these mirror of it and of all surfaces to the
# frames that see them, (N, 3) W/m^2.
Mirrored = Callable[[Environment, Long], Double]


def mirroring(surface: TexturedScene, light: Float, frames: Frames, seed: int) -> Mirrored:
    """What texels of the radiance ``light`` (T, 3) mirror, objects as glossy as their views tell
    in the first environment that is asked about."""
    gloss: Double | None = None

    def mirrored(outside: Environment, index: Long) -> Double:
        nonlocal gloss
        if gloss is None:
            gloss = gloss_of_objects(surface, light, outside, frames, index, seed)
        of_texel = gloss[surface.texels.object_index()[index], None]
        shown = mirrored_to_frames(surface, light, outside, frames, index, seed)
        return np.asarray(np.pi * of_texel * shown)

    return mirrored


def gloss_of_objects(
    surface: TexturedScene,
    light: Float,
    outside: Environment,
    frames: Frames,
    index: Long,
    seed: int,
) -> Double:
    """(num_objects,): the part that objects mirror of what usual dielectrics would, as texels
    ``index`` (N,) tell: by how much the views of a texel differ as what it would mirror to them
    does, next to its radiance. Errors of one frame agree; where the views tell little it is that of
    the scene, of which nothing is expected."""
    texels, some = surface.texels, spread_order(len(frames))[:_FRAMES_OF_GLOSS]
    owner, count = texels.object_index()[index], len(surface.scene.objects)
    views = _some_that_see(surface, frames, index, some, seed)
    shown = _seen_by(surface, frames, index, owner, views)
    # Products of independent noises are none on the mean; but weights that follow from these two
    # would choose views in which they cancel. Weights are the third's.
    one, other, third = (
        _mirrored_to(surface, light, outside, frames, index, views, seed + k * _VIEWS)
        for k in range(3)
    )
    known = np.isfinite(shown[..., 0]) & np.isfinite(one[..., 0])
    known &= known.sum(axis=0) >= _FEWEST_VIEWS
    number = np.maximum(known.sum(axis=0), 1)[:, None]
    level = np.where(known[..., None], shown, 0).sum(axis=(0, 2)) / (3 * number[:, 0])

    def differing(values: Float) -> Double:
        """(M, 3) of the views that are known: from a texel's mean, relative to its radiance."""
        zeroed = np.where(known[..., None], values, 0).astype(np.float64)
        off = (zeroed - zeroed.sum(axis=0) / number) / np.maximum(level, _TINY)[:, None]
        return np.asarray(off[known])

    shown_and_mirrored = differing(shown), differing(one), differing(other), differing(third)
    group = np.broadcast_to(owner, known.shape)[known].astype(np.int64)
    frame = views.T[known]
    scene, error = _slopes(*shown_and_mirrored, np.zeros(len(frame), np.int64), frame, 1)
    part, own_error = _slopes(*shown_and_mirrored, group, frame, count)
    usual = float(np.clip(scene[0], 0, _MOST)) / (1 + (error[0] / _SPREAD) ** 2)
    precision = own_error**-2.0
    mean = (precision * part + _SPREAD**-2 * usual) / (precision + _SPREAD**-2)
    return np.asarray(np.clip(mean, 0, _MOST))


def _slopes(
    y: Double, x: Double, z: Double, third: Double, group: Long, frame: Int, count: int
) -> tuple[Double, Double]:
    """(count,) each: of y (M, 3) on x, of which z and the third are other noisy copies, in each
    group, under Student's t, and its standard error, errors of one frame being one; infinite where
    views do not tell."""
    slope, weight = np.zeros(count), np.ones_like(y)
    size = np.bincount(group, minlength=count)
    for _ in range(_STEPS):
        along = np.maximum(np.bincount(group, (weight * x * z).sum(axis=1), count), 0)
        pull = np.bincount(group, (weight * (x + z) * y).sum(axis=1) / 2, count)
        slope = np.where(along > 0, pull / np.maximum(along, _TINY), 0)
        rest = y - slope[group, None] * third
        scatter = np.sqrt(
            np.bincount(group, (weight * rest**2).mean(axis=1), count) / np.maximum(size, 1)
        )
        noise = np.maximum(scatter, _LEAST_SCATTER)[group, None]
        weight = (_FREEDOM + 1) / (_FREEDOM + (rest / noise) ** 2)
    rest = y - slope[group, None] * (x + z) / 2
    each = (weight * (x + z) * rest).sum(axis=1) / 2
    both = np.unique(np.stack([group, frame]), axis=1, return_inverse=True)
    of_frames = np.bincount(both[1].ravel(), each)
    square = np.bincount(both[0][0], of_frames**2, count)
    error = np.sqrt(square) / np.maximum(along, _TINY)
    # Of few frames the scatter of their sums says little.
    few = np.bincount(both[0][0], minlength=count) < _FEWEST_FRAMES
    return slope, np.where(few | (along <= 0), np.inf, np.maximum(error, _TINY))


def _seen_by(surface: TexturedScene, frames: Frames, index: Long, owner: Int, views: Int) -> Float:
    """(_VIEWS, N, 3): what frames ``views`` (N, _VIEWS) show of texels ``index`` (N,), NaN where
    they show nothing."""
    kind, shown = _samples_of(surface, frames, index, owner, views)
    return np.where((kind == SAMPLE)[..., None], shown, np.float32(np.nan))


def _samples_of(
    surface: TexturedScene, frames: Frames, index: Long, owner: Int, views: Int
) -> tuple[npt.NDArray[np.int8], Float]:
    """(_VIEWS, N) and (_VIEWS, N, 3): as of ``samples_from_frame``, NOTHING where there is none."""
    texels = surface.texels
    kinds = np.full((_VIEWS, len(index)), NOTHING, np.int8)
    shown = np.zeros((_VIEWS, len(index), 3), np.float32)
    order = [int(i) for i in np.unique(views) if i >= 0]
    for i, pixels in read_frames(partial(read_frame, frames), order):
        column, row = np.nonzero(views == i)
        camera = frames.camera(i)
        surfaces = first_surfaces(surface.rays, surface.scene.face_object, camera)
        picture = Picture.of(pixels)._replace(radiance=np.nan_to_num(pixels.radiance))
        kinds[row, column], shown[row, column] = samples_from_frame(
            texels.take(index[column]), owner[column], surfaces, picture, camera
        )
    return kinds, shown


def angles_of_glare(surface: TexturedScene, frames: Frames, index: Long, seed: int) -> Double:
    """(N,) degrees: how far apart directions are from which frames see texels ``index`` (N,) clip,
    at most, of some of these frames; 0 of fewer than two. A mirror image stays where it is."""
    owner, texels = surface.texels.object_index()[index], surface.texels
    views = _some_that_see(surface, frames, index, range(len(frames)), seed)
    clips = _samples_of(surface, frames, index, owner, views)[0].T == CLIPPED
    eyes = np.stack([frames.camera(i).eye for i in range(len(frames))])
    towards = eyes[views] - texels.position[index][:, None]
    towards /= np.linalg.norm(towards, axis=2, keepdims=True)
    cosine = np.einsum("nik,njk->nij", towards, towards)
    both = clips[:, :, None] & clips[:, None]
    least = np.where(both, cosine, 1.0).min(axis=(1, 2))
    return np.asarray(np.degrees(np.arccos(np.clip(least, -1, 1))), np.float64)


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


def _mirrored_to(
    surface: TexturedScene,
    light: Float,
    outside: Environment,
    frames: Frames,
    index: Long,
    views: Int,
    seed: int,
) -> Float:
    """(_VIEWS, N, 3) W/(m^2 sr): what texels ``index`` (N,) would mirror to frames ``views``
    (N, _VIEWS), NaN where that is -1."""
    lit, texels = _of_dielectrics(surface, light, outside), surface.texels
    eyes = np.stack([frames.camera(i).eye for i in range(len(frames))])
    shown = np.full((_VIEWS, len(index), 3), np.nan, np.float32)
    for k, (row, frame) in enumerate(zip(shown, views.T, strict=True)):
        which = np.flatnonzero(frame >= 0)
        own = index[which]
        points = points_of_texels(texels, own, eyes[frame[which]])
        phi, psi = (np.full(len(own), value, np.float32) for value in (_PHI, _PSI))
        row[which] = lobe_radiance(lit, points, phi, psi, _RAYS_OF_VIEW, seed + k, own)
    return shown


def _of_dielectrics(surface: TexturedScene, light: Float, outside: Environment) -> LitScene:
    shines = np.zeros(len(surface.texels), np.bool_)
    return replace(lit_scene(surface, light, shines, outside), lobe=DIELECTRIC)


def _some_that_see(
    surface: TexturedScene, frames: Frames, index: Long, some: Sequence[int], seed: int
) -> Int:
    """(N, _VIEWS): frames among ``some`` that see texels ``index`` (N,), drawn from all that do; -1
    for none. What a texel gets depends on nothing but its number."""
    texels, count = surface.texels, len(index)
    position, normal = texels.position[index], texels.geometric_normal[index]
    owner = texels.object_index()[index]
    points = MeshPoints(position.astype(np.float64), normal.astype(np.float64), owner)
    # The lowest numbers win; one that does not see the texel has none.
    best, frame = np.full((count, _VIEWS), np.inf), np.full((count, _VIEWS), -1, np.int32)
    for i in some:
        seen = seen_points(points, surface.rays, frames.camera(i))[0]
        drawn = np.where(seen, shifts_of(index, 1, seed + i)[:, 0], np.inf)
        last = best.argmax(axis=1)
        better = np.flatnonzero(drawn < np.take_along_axis(best, last[:, None], axis=1)[:, 0])
        best[better, last[better]], frame[better, last[better]] = drawn[better], i
    return frame
