"""One object's roughness and specular from one frame alone, the paper's way: its target frame
(section 3.4.1), roughness by a two-level grid, specular by closed-form least squares (3.4.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeVar

import numpy as np
from scipy import ndimage

from usdbrdf import calibration
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.transport.brdf import F0_OF_PSI, PAPER
from usdbrdf.transport.lit_scene import (
    LitScene,
    SurfacePoints,
    View,
    hits_in_mirror,
    sub_pixel_points,
    visible_points,
)
from usdbrdf.transport.lobe_radiance import lobe_basis

Basis = Callable[[float], tuple[Float, Float]]
Projection = Callable[[Double], Double]
# Roughnesses of each level.
GRID = 11
_FLAT = calibration.number("fit_of_frame.flat_cost")


@dataclass(frozen=True, kw_only=True)
class FrameCounts:
    """Per object: pixels whose mirror ray hits an emitter and that are valid (A1 and A2), and valid
    pixels (A2); (num_objects,) int64 each."""

    mirrored: Long
    valid: Long


def mirror_hits_emitter(lit: LitScene, points: SurfacePoints) -> Bool:
    """A1 (R,): would a perfect mirror at the point show an emitter to the camera?"""
    hits = hits_in_mirror(lit, points)
    return lit.emits(hits) & (hits.face >= 0) & (points.face >= 0)


def count_frame(lit: LitScene, valid: Bool, camera: Camera, stride: int) -> FrameCounts:
    """A1 and A2 counted per object over every ``stride``-th pixel of a frame, valid (H, W)."""
    points = visible_points(lit, camera, camera.pixels(stride))
    owner = lit.owner(points.face)
    good = valid[::stride, ::stride].ravel() & (owner >= 0)
    mirrored = good & mirror_hits_emitter(lit, points)
    number = len(lit.scene.objects)
    return FrameCounts(
        mirrored=np.bincount(owner[mirrored], minlength=number),
        valid=np.bincount(owner[good], minlength=number),
    )


def choose_target_frames(counts: Iterable[FrameCounts]) -> tuple[Int, Int]:
    """Per object: the frame with most pixels in A1 and A2, and how many those are.

    An object that mirrors an emitter in no frame takes the frame with most valid pixels (count 0);
    an object without any valid pixel gets frame -1.
    """
    frames = list(counts)
    mirrored = np.stack([frame.mirrored for frame in frames])
    valid = np.stack([frame.valid for frame in frames])
    target = np.where(mirrored.max(axis=0) > 0, mirrored.argmax(axis=0), valid.argmax(axis=0))
    target = np.where(valid.max(axis=0) > 0, target, -1)
    return target.astype(np.int32), mirrored.max(axis=0).astype(np.int32)


def object_pixels(
    owner: Int, valid: Bool, highlight: Bool, index: int, limit: int, pick: Callable[[int], Long]
) -> tuple[Long, Float]:
    """Flat indices of the pixels of object ``index`` to fit, at most ``limit``, and how many pixels
    each stands for, (P,) float32.

    owner (H, W): object per pixel; valid (H, W); highlight (H, W): A1. Pixels next to another
    object are left out (they mix both). Where there are more than ``limit``, ``pick(n)`` orders
    them at random and half of them are taken within 30 pixels of a mirrored emitter, where the
    lobe shows.
    """
    own = owner == index
    inner = ndimage.binary_erosion(own, np.ones((3, 3)))
    candidates = np.flatnonzero(inner & valid)
    if len(candidates) <= limit:
        return candidates, np.ones(len(candidates), np.float32)
    candidates = candidates[pick(len(candidates))]
    near = np.zeros(len(candidates), np.bool_)
    if (highlight & own).any():
        near = ndimage.distance_transform_edt(~(highlight & own)).ravel()[candidates] <= 30
    close, far = candidates[near], candidates[~near]
    take = min(len(close), max(limit // 2, limit - len(far)))
    parts = (close[:take], close), (far[: limit - take], far)
    chosen = np.concatenate([taken for taken, _ in parts])
    stands_for = np.concatenate([np.full(len(t), len(of) / max(len(t), 1)) for t, of in parts])
    order = np.argsort(chosen)
    return chosen[order], stands_for[order].astype(np.float32)


class GridFit(NamedTuple):
    """phi, psi in [0, 1]; the roughnesses phi_low..phi_high that fit as well within 1 %; cost at
    phi, psi per residual; evidence = 1 - cost / cost without any specular light."""

    phi: float
    psi: float
    phi_low: float
    phi_high: float
    cost: float
    evidence: float


def fit_grid(observed: Float, weight: Float, basis: Basis, without_diffuse: Projection) -> GridFit:
    """Fit one object to P observations.

    observed         (P, 3) float32, radiance
    weight           (P, 1) float32, of the squared residual
    basis            phi -> (base, slope), (P, 3) each
    without_diffuse  projection of (P, 3) values that are multiplied by the root of the weight

    Two levels of K = 11: [0, 1], then between the neighbours of the first level's minimiser. Where
    the cost is flat around its minimum (with psi at 0 hardly anything depends on phi), the
    minimiser is noise; phi is then the middle of the flat interval.
    """
    root = np.sqrt(weight).astype(np.float64)
    target = without_diffuse(observed * root)

    def solve(phi: float) -> tuple[float, float]:
        base, slope = basis(phi)
        rest = target - without_diffuse(base * root)
        slope_left = without_diffuse(slope * root)
        square = float((slope_left * slope_left).sum())
        psi = float((slope_left * rest).sum()) / square if square > 0 else 0.0
        # The cost is that of the clamped psi; ``base`` stays at 0.
        psi = min(1.0, max(0.0, psi))
        left = rest - psi * slope_left
        return float((left * left).sum()), psi

    tried = _two_levels(solve)
    low, phi, high = _flat_interval({phi: cost for phi, (cost, _) in tried.items()})
    cost, psi = tried[phi]
    evidence = _explained(cost, target)
    return GridFit(phi, psi, low, high, cost / max(target.size, 1), evidence)


class MetalFit(NamedTuple):
    """phi in [0, 1]; f0 (3,) in [0, 1], reflectance at normal incidence; the roughnesses
    phi_low..phi_high that fit as well within 1 %; cost per residual; evidence = 1 - cost / cost
    of a black surface."""

    phi: float
    f0: tuple[float, float, float]
    phi_low: float
    phi_high: float
    cost: float
    evidence: float


def fit_metal(observed: Float, weight: Float, basis: Basis) -> MetalFit:
    """Fit a lobe without a diffuse part, with a reflectance of its own in each channel; arguments
    and levels as of ``fit_grid``."""
    root = np.sqrt(weight).astype(np.float64)
    target = observed * root

    def solve(phi: float) -> tuple[float, Double]:
        base, slope = (part * root for part in basis(phi))
        slope = slope / F0_OF_PSI
        square = np.maximum((slope * slope).sum(axis=0), 1e-30)
        f0 = np.clip((slope * (target - base)).sum(axis=0) / square, 0, 1)
        left = target - base - f0 * slope
        return float((left * left).sum()), f0

    tried = _two_levels(solve)
    low, phi, high = _flat_interval({phi: cost for phi, (cost, _) in tried.items()})
    cost, (red, green, blue) = tried[phi][0], tried[phi][1].tolist()
    evidence = _explained(cost, target)
    return MetalFit(phi, (red, green, blue), low, high, cost / max(target.size, 1), evidence)


Solved = TypeVar("Solved")


def _two_levels(
    solve: Callable[[float], tuple[float, Solved]],
) -> dict[float, tuple[float, Solved]]:
    """What ``solve`` finds at each roughness tried, its cost first."""
    tried: dict[float, tuple[float, Solved]] = {}

    def level(low: float, high: float) -> tuple[float, float]:
        grid = [float(phi) for phi in low + np.arange(GRID) * (high - low) / (GRID - 1)]
        for phi in grid:
            if phi not in tried:
                tried[phi] = solve(phi)
        best = min(range(GRID), key=lambda k: tried[grid[k]][0])
        return grid[max(best - 1, 0)], grid[min(best + 1, GRID - 1)]

    level(*level(0.0, 1.0))
    return tried


def _explained(cost: float, target: Double) -> float:
    unexplained = float((target * target).sum())
    return max(0.0, 1.0 - cost / unexplained if unexplained > 0 else 0.0)


def nothing(values: Double) -> Double:
    """The projection for residuals from which I_d is subtracted."""
    return values


def multiple_of(diffuse: Float | Double) -> Projection:
    """Takes the best multiple of ``diffuse`` (P, 3), weighted like the values, off each channel."""
    square = np.maximum((diffuse * diffuse).sum(axis=0), 1e-30)

    def project(values: Double) -> Double:
        rest: Double = values - diffuse * ((diffuse * values).sum(axis=0) / square)
        return rest

    return project


def _flat_interval(tried: Mapping[float, float]) -> tuple[float, float, float]:
    """Lowest, middle and highest roughness of the flat stretch around the minimum; tried: roughness
    -> cost."""
    phis = sorted(tried)
    costs = [tried[phi] for phi in phis]
    best = min(range(len(phis)), key=costs.__getitem__)
    first = last = best
    while first > 0 and costs[first - 1] <= (1 + _FLAT) * costs[best]:
        first -= 1
    while last + 1 < len(phis) and costs[last + 1] <= (1 + _FLAT) * costs[best]:
        last += 1
    middle = (phis[first] + phis[last]) / 2
    nearest = min(phis[first : last + 1], key=lambda phi: (abs(phi - middle), phi))
    return phis[first], nearest, phis[last]


Residual = Literal["paper", "scaled"]
# A pixel sees an area: its rays start at 2 x 2 points of it. On small curved objects the normal
# turns within a pixel; taken at its centre alone, the highlight looks rougher than it is.
_SUB_PIXEL = 0.25 * np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]])
MIN_PIXELS = calibration.count("fit_of_frame.min_pixels")


class FrameSamples(NamedTuple):
    """P pixels of one object in a frame: what they show, and how much of it is diffuse, (P, 3)
    radiance each; how many pixels each stands for, (P,); and the basis of what its lobe adds, see
    ``lobe_basis``: kind of lobe, roughnesses (Q,) -> (base, slope), (P, 3, Q) each."""

    observed: Float
    diffuse: Float
    stands_for: Float
    of_phis: Callable[[int, Sequence[float]], tuple[Float, Float]]

    def weight(self) -> Float:
        """(P, 1), of squared residuals: errors of L_d and of the frame grow with the radiance; the
        floor keeps the noise of dark pixels small."""
        level = self.diffuse.mean(axis=1, keepdims=True)
        # Its square is a number in single precision too.
        floor = max(0.1 * float(np.median(level)), 1e-15)
        return np.asarray(1 / (level + floor) ** 2, np.float32)


class FrameSeen(NamedTuple):
    """What the pixels of a frame show, whichever object is asked for: the object, or -1, (H, W)
    int32; A1 and A2, (H, W)."""

    owner: Int
    highlight: Bool


def seen_in_frame(lit: LitScene, view: View) -> FrameSeen:
    """The same of all pixels of a frame, traced."""
    shape = view.valid.shape
    points = visible_points(lit, view.camera, view.camera.pixels())
    highlight = mirror_hits_emitter(lit, points).reshape(shape) & view.valid
    return FrameSeen(lit.owner(points.face).reshape(shape), highlight)


def frame_samples(
    lit: LitScene, view: View, seen: FrameSeen, index: int, max_pixels: int, seed: int
) -> tuple[FrameSamples | None, int]:
    """At most ``max_pixels`` of object ``index``, and their number; None if they are too few.

    seen  of the same view: to trace it takes longer than all that is done for one object

    Each pixel is the mean of 2 x 2 surface points with 52 rays each, traced once for all
    roughnesses.
    """
    random = np.random.default_rng([seed, index])
    chosen, stands_for = object_pixels(
        seen.owner, view.valid, seen.highlight, index, max_pixels, random.permutation
    )
    at = view.camera.pixels()[chosen]
    whole, points = sub_pixel_points(lit, view.camera, at, index, _SUB_PIXEL)
    chosen, stands_for = chosen[whole], stands_for[whole]
    if len(chosen) < MIN_PIXELS:
        return None, len(chosen)
    diffuse = lit.radiance.at(points.face, points.u, points.v)
    diffuse = diffuse.reshape(len(chosen), -1, 3).mean(axis=1)
    observed = view.radiance.reshape(-1, 3)[chosen]
    of_phis = lobe_basis(lit, points, len(chosen), seed)
    return FrameSamples(observed, diffuse, stands_for, of_phis), len(chosen)


def fit_target_frame(
    lit: LitScene, view: View, index: int, residual: Residual, max_pixels: int, seed: int
) -> tuple[GridFit | None, int]:
    """Fit object ``index`` in its target frame: (fit, number of pixels), fit None if too few."""
    seen = seen_in_frame(lit, view)
    samples, number = frame_samples(lit, view, seen, index, max_pixels, seed)
    if samples is None:
        return None, number
    basis = _of_one_phi(samples)
    observed, diffuse = samples.observed, samples.diffuse
    if residual == "paper":
        # The paper sums over all pixels alike; what was left out is stood for by what was taken.
        stands_for = samples.stands_for
        weight = (stands_for / max(float(stands_for.mean()), 1e-12))[:, None]
        return fit_grid(observed - diffuse, weight, basis, nothing), number
    # Highlights count for more than their share of pixels.
    weight = samples.weight()
    return fit_grid(observed, weight, basis, multiple_of(diffuse * np.sqrt(weight))), number


def metal_of_target_frame(
    lit: LitScene, view: View, index: int, max_pixels: int, seed: int
) -> tuple[MetalFit | None, int]:
    """The same of an object that somebody knows to be a metal, residuals as of "scaled": what it
    shows is all lobe, also what the texture holds of it."""
    seen = seen_in_frame(lit, view)
    samples, number = frame_samples(lit, view, seen, index, max_pixels, seed)
    if samples is None:
        return None, number
    return fit_metal(samples.observed, samples.weight(), _of_one_phi(samples)), number


def _of_one_phi(samples: FrameSamples) -> Basis:
    def basis(phi: float) -> tuple[Float, Float]:
        base, slope = samples.of_phis(PAPER, [phi])
        return base[..., 0], slope[..., 0]

    return basis


def relative_costs(
    lit: LitScene, samples: FrameSamples, phis: Sequence[float], psis: Sequence[float]
) -> Double:
    """(Q, R): what lobes of the scene's kind with roughnesses ``phis`` (Q,) and speculars ``psis``
    (R,) leave unexplained of a frame, residuals as of "scaled", relative to no lobe at all."""
    root = np.sqrt(samples.weight()).astype(np.float64)
    without_diffuse = multiple_of(samples.diffuse.astype(np.float64) * root)
    target = without_diffuse(samples.observed * root)
    bases, slopes = samples.of_phis(lit.lobe, phis)
    # Where the diffuse light explains all but rounding, there is nothing for a lobe to explain.
    whole = float(((samples.observed * root) ** 2).sum())
    alone = max(float((target * target).sum()), 1e-9 * whole, 1e-30)
    costs = np.empty((len(phis), len(psis)))
    for k in range(len(phis)):
        rest = target - without_diffuse(bases[..., k] * root)
        slope = without_diffuse(slopes[..., k] * root)
        terms = (rest * rest).sum(), (slope * rest).sum(), (slope * slope).sum()
        costs[k] = [terms[0] - 2 * psi * terms[1] + psi**2 * terms[2] for psi in psis]
    return costs / alone
