"""What photographs could show that the frames so far did not: from every place and in every
direction which points of the surface, and how lobes would look there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from usdbrdf.advice.knowledge import (
    PHIS,
    Exposure,
    Lobes,
    Outlook,
    Products,
    contrast,
    outlook,
    share_of_enough,
    view_of,
)
from usdbrdf.advice.sight import Spots, in_pictures, visible_spots
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool, Double, Float, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.texels import Texels
from usdbrdf.transport.brdf import DIELECTRIC
from usdbrdf.transport.let_through import kept_below
from usdbrdf.transport.lit_scene import LitScene
from usdbrdf.transport.lobe_radiance import Mixture, lobe_basis

# Points on each object whose lobe is to be found, and on the whole surface; rays of each point.
_OF_OBJECT, _OF_SURFACE = 256, 6000
_MIXTURE = Mixture(per_lobe=3, lights=8, cosine=6)
# Directions from each place: so many around, at these degrees above the horizon.
_AROUND, _PITCHES = 16, (-65.0, -45.0, -25.0, -8.0, 10.0, 30.0, 55.0)


@dataclass(frozen=True, kw_only=True)
class Target:
    """An object whose lobe is not known yet.

    index     of the object
    own       its points among all spots
    likely    (H,) how likely each lobe is; typical (K,) the mean of them
    products  what the frames so far tell
    holds     the share of the reckoned contrast that the fit found in the frames so far
    samples   how many samples the fit had for each that is reckoned with
    coarser   how many times larger the fit's errors of phi and psi are than they are reckoned
    sights    of each place that sees it: which of its points, (M,), and their basis (M, K)
    """

    index: int
    own: slice
    likely: Double
    typical: Double
    products: Products
    holds: float = 1.0
    samples: float = 1.0
    coarser: tuple[float, float] = (1.0, 1.0)
    sights: dict[int, tuple[Long, Double]] = field(default_factory=dict)

    def expected(self, known: Lobes, *more: tuple[Long, Double, Double]) -> Outlook:
        """After the frames so far and further photographs: points (M,), weights (M,), basis
        (M, K) of each."""
        products = self.products
        if more:
            products = Products(*(values.copy() for values in products))
            for which, weight, basis in more:
                products.add(which, weight, basis)
        holds = self.holds * share_of_enough(products, self.samples)
        contrasts = holds * contrast(products, self.typical)
        return outlook(known, self.likely, contrasts, self.coarser)


@dataclass(frozen=True, kw_only=True)
class Survey:
    """All that poses are chosen from.

    spots     points on the surface: first ``of_surface`` of them, evenly by area, then those of
              ``targets``; level (N,), their diffuse radiance
    area      (of_surface,) m^2 that each stands for
    unseen    (of_surface,) bool: no frame shows it
    clipped   (of_surface,) bool: it clips in every frame that shows it
    places    (M, 3); visible, of each place the spots that a camera there sees wherever it looks
    looks     (L, 3, 3) rotations, world from camera
    inside    of each place (L, visible) bool: which of these lie in the picture
    camera    with the lens and the pixels of the photographs to come
    exposures to choose from, the longest first
    """

    spots: Spots
    level: Double
    of_surface: int
    area: Double
    unseen: Bool
    clipped: Bool
    targets: tuple[Target, ...]
    lobes: Lobes
    places: Double
    visible: tuple[Long, ...]
    looks: Double
    inside: tuple[Bool, ...]
    camera: Camera
    exposures: tuple[Exposure, ...]


def chosen_spots(
    texels: Texels, objects: Sequence[int], shines: Bool, seed: int
) -> tuple[Spots, list[slice], int]:
    """Points on the surface: evenly by area on all of it, then on each of the ``objects`` where
    nothing shines (T,); where each object's are, and the number of the former."""
    random = np.random.default_rng(seed)
    # Each texel has a place on a line by its area; equally spaced marks pick evenly.
    ends = np.cumsum(texels.area, dtype=np.float64)
    marks = (np.arange(_OF_SURFACE) + random.random(_OF_SURFACE)) / _OF_SURFACE * ends[-1]
    picked = [np.minimum(np.searchsorted(ends, marks), len(ends) - 1)]
    own, first = [], _OF_SURFACE
    for index in objects:
        part = texels.of_object(index)
        usable = part.start + np.flatnonzero(~shines[part] & (texels.area[part] > 0))
        share = texels.area[usable].astype(np.float64)
        count = min(_OF_OBJECT, len(usable))
        some = random.choice(usable, count, replace=False, p=share / share.sum() if count else None)
        picked.append(np.sort(some))
        own.append(slice(first, first + count))
        first += count
    return Spots.of(texels, np.concatenate(picked)), own, _OF_SURFACE


def seen_by_frames(
    lit: LitScene,
    spots: Spots,
    level: Double,
    targets: Sequence[Target],
    cameras: Sequence[Camera],
    exposures: Sequence[Exposure],
    seed: int,
) -> None:
    """Add to the targets' products what the frames so far tell."""
    seen = []
    for camera in progress(cameras, total=len(cameras), label="advise", unit="frames"):
        visible = visible_spots(lit, spots, camera.eye, camera.intrinsics[0])
        turn = camera.world_from_camera[None, :3, :3]
        seen.append(visible[in_pictures(camera, camera.eye, turn, spots.position[visible])[0]])
    eyes = np.array([camera.eye for camera in cameras])
    for target in targets:
        for i, (which, basis) in _bases(lit, spots, target.own, seen, eyes, seed).items():
            own = level[target.own][which]
            weight, free = view_of(own, basis, target.typical, exposures[i])
            target.products.add(which, weight, free)


def all_looks(up: int) -> Double:
    """(L, 3, 3) rotations of cameras that look around, world from camera, upright."""
    ahead, side, above = (np.eye(3)[(up + k) % 3] for k in (1, 2, 0))
    found = []
    for row, pitch in enumerate(np.radians(_PITCHES)):
        for k in range(_AROUND):
            turn = 2 * math.pi * (k + 0.5 * (row % 2)) / _AROUND
            level = math.cos(turn) * ahead + math.sin(turn) * side
            back = -(math.cos(pitch) * level + math.sin(pitch) * above)
            right = np.cross(above, back)
            right /= np.linalg.norm(right)
            found.append(np.stack([right, np.cross(back, right), back], axis=1))
    return np.array(found)


def look_from(
    lit: LitScene,
    spots: Spots,
    targets: Sequence[Target],
    places: Double,
    looks: Double,
    camera: Camera,
    seed: int,
) -> tuple[tuple[Long, ...], tuple[Bool, ...]]:
    """``Survey.visible`` and ``inside``; the targets get their ``sights``."""
    visible, inside = [], []
    for eye in progress(places, total=len(places), label="advise", unit="places"):
        which = visible_spots(lit, spots, eye, camera.intrinsics[0])
        visible.append(which)
        inside.append(in_pictures(camera, eye, looks, spots.position[which]))
    for target in targets:
        target.sights.update(_bases(lit, spots, target.own, visible, places, seed))
    return tuple(visible), tuple(inside)


def placed(camera: Camera, eye: Double, turn: Double) -> Camera:
    """The camera at an eye (3,), turned (3, 3)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, eye
    return Camera(
        world_from_camera=pose,
        intrinsics=camera.intrinsics,
        width=camera.width,
        height=camera.height,
        name=camera.name,
    )


def _bases(
    lit: LitScene, spots: Spots, own: slice, seen: Sequence[Long], eyes: Double, seed: int
) -> dict[int, tuple[Long, Double]]:
    """Of each view that sees any of an object's points: which of them, and their basis (M, K).

    A point has the same random numbers in all its views: what these have in common cancels."""
    parts = [which[(which >= own.start) & (which < own.stop)] for which in seen]
    if not (number := sum(map(len, parts))):
        return {}
    every = np.concatenate(parts)
    view = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    points = spots.towards(every, eyes[view])
    base, slope = lobe_basis(lit, points, number, seed, _MIXTURE, every)(lit.lobe, PHIS)
    if lit.lobe == DIELECTRIC:
        cosine = (points.normal * points.to_camera).sum(axis=1)
        diffuse = lit.radiance.at(points.face, points.u, points.v)[..., None]
        base, slope = (
            part - diffuse * kept[:, None]
            for part, kept in zip((base, slope), kept_below(PHIS, cosine), strict=True)
        )
    basis = np.concatenate([base.mean(axis=1), slope.mean(axis=1)], axis=1).astype(np.float64)
    ends = np.cumsum([len(part) for part in parts])[:-1]
    return {
        i: (part - own.start, rows)
        for i, (part, rows) in enumerate(zip(parts, np.split(basis, ends), strict=True))
        if len(part)
    }


def level_of(lit: LitScene, radiance: Float, spots: Spots) -> Double:
    """(N,): mean of the channels of per-texel radiance (T, 3) at the spots."""
    return np.asarray(radiance[spots.texel].mean(axis=1), np.float64)
