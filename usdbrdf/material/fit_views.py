"""One object's roughness and specular from many views, its diffuse radiance left free per texel.

A texel's diffuse radiance is the same in all frames that see it: what changes with the view is the
lobe, and the errors of the frames, which ``view_model`` tells from it. The median texture, which
holds the specular light that is seen from everywhere, then enters as incident light only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial, reduce
from typing import NamedTuple

import numpy as np
from scipy import sparse

from usdbrdf import calibration
from usdbrdf.material.conductor import Conductor, conductor_of
from usdbrdf.material.fit_lobe import (
    Candidate,
    FittedKind,
    Pair,
    first_seed,
    fit_lobe,
    repeated_where_noisy,
)
from usdbrdf.material.observations import Observations
from usdbrdf.material.seen_through import radiance_behind, seen_through
from usdbrdf.material.verdict import (
    MAX_PSI_ERROR,
    MOST_CONTRADICTED,
    SOME_EVIDENCE,
    LobeEstimate,
    verdict_on_views,
)
from usdbrdf.material.view_model import LEAST_DIFFUSE, ViewSamples
from usdbrdf.model.arrays import Bool, Double, Float, Int, Long
from usdbrdf.model.camera import Camera
from usdbrdf.texturing.footprints import RINGS
from usdbrdf.transport.brdf import CONDUCTOR, F0_OF_PSI, PAPER, is_dielectric
from usdbrdf.transport.let_through import USUAL_F0, kept_below
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, sub_pixel_points
from usdbrdf.transport.lobe_radiance import Basis, Mixture, lobe_basis

_FOOTPRINT = calibration.number("fit.footprint")
_OTHER_WIDTHS_PX = calibration.numbers("fit.wider_footprints")
_KEPT = calibration.number("fit.kept_in_footprint")
_SPREAD_OF_WIDTHS = math.log(calibration.number("fit.spread_of_footprints"))
_CURVED = calibration.number("fit.curved_from")
MIN_OBSERVATIONS = calibration.count("fit.min_observations")
MIN_VIEWS = calibration.count("fit.min_views")
ABOVE_NOISE = calibration.number("fit.above_noise")
# Of curved objects few samples tell: their lobes and lights get so many times the rays.
MIXTURE = Mixture(per_lobe=4, lights=8, cosine=8)
_TIMES_FOR_CURVED = 2
_CELL_PIXELS = calibration.number("fit.shared_error_size")
# Of a refractive index of 1.5.
_USUAL_PSI = USUAL_F0 / F0_OF_PSI
_SEED_OF_THROUGH, _SEED_OF_METAL = 0x71E0, 0x3E7A
# What a model leaves is the product of what two bases with noise of their own leave: where that is
# much, it may happen to be next to nothing. A metal that is found is held against so many times the
# rays.
_MORE_FOR_METAL = 4


class SampledPart(NamedTuple):
    """The samples of an object in one lighting.

    observed    those whose footprint lies on the object as a whole
    footprints  surface points of each sample, for the usual width and, on curved objects, others
    irradiance  (P, 3), W/m^2, S at each sample's texel; None where it is not known
    doubt       the scene in nothing but the standard errors of its light; None where it was seen
    """

    lit: LitScene
    observed: Observations
    footprints: list[SurfacePoints]
    irradiance: Float | None
    doubt: LitScene | None = None


class SampledObject(NamedTuple):
    """What the fits of one object are made of.

    parts    its samples in each lighting that shows it
    samples  all of these after each other, with their errors; a texel's diffuse radiance is another
             in each lighting, so it counts as many
    widths   standard deviations of the footprints in pixels, for which all parts have points
    likely   of each of these, before the samples are asked
    mixture  the rays of each point
    """

    parts: list[SampledPart]
    samples: ViewSamples
    widths: tuple[float, ...]
    likely: list[float]
    mixture: Mixture

    def basis(self, width: int, seed: int) -> Basis:
        """Views of a texel share their random numbers: what they have in common then cancels in
        their differences, which are all that is fitted."""
        of_parts = [
            lobe_basis(part.lit, part.footprints[width], len(stream), seed, self.mixture, stream)
            for part, stream in self._parts_with_texels()
        ]

        cosine = cache(lambda: self._cosine(width))

        def basis(kind: int, phis: Sequence[float]) -> tuple[Float, Float]:
            bases, slopes = zip(*(one(kind, phis) for one in of_parts), strict=True)
            base, slope = np.concatenate(bases), np.concatenate(slopes)
            if not is_dielectric(kind):
                return base, slope
            diffuse = self._diffuse(base + np.float32(_USUAL_PSI) * slope)
            of_base, of_slope = (kept[:, None] for kept in kept_below(phis, cosine()))
            return base - diffuse * of_base, slope - diffuse * of_slope

        return basis

    def behind(self, index: int) -> Float:
        """(P, 3) W/(m^2 sr): what each sample's rays meet behind the object ``index``, which they
        are of, on the mean over the usual footprint."""
        found = [
            radiance_behind(part.lit, part.footprints[0], index).reshape(-1, len(RINGS), 3).mean(1)
            for part in self.parts
        ]
        return np.concatenate(found)

    def lobe(self, kind: int, phi: float, seed: int, *, of_doubt: bool = False) -> Pair:
        """(base, slope) of I_nd = base + psi slope, (P, 3, 1) each, of the usual footprint and what
        the surface reflects alone; of_doubt: of what the light may be off by."""
        found = []
        for part, stream in self._parts_with_texels():
            lit = part.doubt if of_doubt else part.lit
            if lit is None:
                nothing = np.zeros((len(stream), 3, 1), np.float32)
                found.append((nothing, nothing))
                continue
            points, mixture = part.footprints[0], self.mixture
            found.append(lobe_basis(lit, points, len(stream), seed, mixture, stream)(kind, [phi]))
        base, slope = map(np.concatenate, zip(*found, strict=True))
        return base, slope

    def _parts_with_texels(self) -> Iterator[tuple[SampledPart, Long]]:
        """Each part with what ``samples`` call the texels of its own samples."""
        ends = np.cumsum([len(part.observed.texel) for part in self.parts])
        return zip(self.parts, np.split(self.samples.texel, ends[:-1]), strict=True)

    def _cosine(self, width: int) -> Float:
        """(P,): of the angle between the normal and the camera, the mean over the footprint."""
        found = []
        for part in self.parts:
            points = part.footprints[width]
            cosine = (points.normal * points.to_camera).sum(axis=1)
            found.append(cosine.reshape(len(part.observed.texel), -1).mean(axis=1))
        return np.concatenate(found)

    def _diffuse(self, lobe: Float) -> Float:
        """(P, 3, K) W/(m^2 sr): about the diffuse radiance of each sample's texel, what it shows on
        the mean without the ``lobe``, (P, 3, K) too."""
        texel = self.samples.texel
        views = sparse.csr_matrix((np.ones(len(texel), np.float32), (texel, np.arange(len(texel)))))
        number = np.bincount(texel).astype(np.float32)[:, None]

        def of_texel(values: Float) -> Float:
            means: Float = (views @ values.reshape(len(values), -1) / number)[texel]
            return means.reshape(values.shape)

        seen = of_texel(self.samples.radiance)[..., None]
        diffuse: Float = np.maximum(seen - of_texel(lobe), np.float32(LEAST_DIFFUSE) * seen)
        return diffuse

    @property
    def irradiance(self) -> Float | None:
        """(P, 3), W/m^2, of all samples; None where it is not known of all."""
        known = [part.irradiance for part in self.parts if part.irradiance is not None]
        return np.concatenate(known) if len(known) == len(self.parts) else None


def joined_object(several: Sequence[SampledObject]) -> SampledObject | None:
    """One object as several lightings show it; None if none does.

    Parts whose samples allow fewer footprints than those of most samples are left out.
    """
    if len(several) < 2:
        return several[0] if several else None
    most = max(several, key=lambda one: len(one.samples.texel))
    several = [one for one in several if len(one.widths) >= len(most.widths)]
    sizes = [len(one.samples.texel) for one in several]
    texels = np.cumsum([0, *(int(one.samples.texel.max()) + 1 for one in several[:-1])])
    samples = ViewSamples(
        texel=np.concatenate(
            [one.samples.texel + n for one, n in zip(several, texels, strict=False)]
        ),
        frame=np.concatenate([one.samples.frame for one in several]),
        position=np.concatenate([one.samples.position for one in several]),
        radiance=np.concatenate([one.samples.radiance for one in several]),
        noise=np.concatenate([one.samples.noise for one in several]),
        cell=float(np.average([one.samples.cell for one in several], weights=sizes)),
    )
    count = len(most.widths)
    likely = np.average([one.likely[:count] for one in several], axis=0, weights=sizes)
    parts = [part for one in several for part in one.parts]
    return SampledObject(parts, samples, most.widths, likely.tolist(), most.mixture)


def sampled_object(
    lit: LitScene,
    observed: Observations,
    smoothing: float,
    camera_of: Callable[[int], Camera],
    index: int,
    mixture: Mixture = MIXTURE,
    irradiance: Float | None = None,
    doubt: LitScene | None = None,
) -> tuple[SampledObject | None, int]:
    """Object ``index`` as its observations show it, and the number of samples; None if too few.

    smoothing: of the pictures, in pixels, see ``smoothing_of``. camera_of(frame): the images
    themselves are not needed.
    mixture: the rays of each of a sample's points, traced three times, or where their noise matters
    fifteen times; curved objects have more. irradiance (T, 3): S, W/m^2. doubt: see SampledPart.
    """
    observed = observed.take(np.flatnonzero(_clear_of_noise(observed)))
    if not len(observed.texel):
        return None, 0
    observed, footprints = _footprints(lit, observed, camera_of, index)
    if len(observed.texel) < MIN_OBSERVATIONS:
        return None, len(observed.texel)
    position, points = lit.texels.position[observed.texel], footprints[0]
    # Views cut a pattern differently: its contrast within the footprint is an error of the sample,
    # or, of a square's mean, that along its rim.
    shown = lit.radiance.at(points.face, points.u, points.v)
    contrast = shown.reshape(len(position), len(RINGS), 3).std(axis=1) / observed.side[:, None]
    samples = ViewSamples(
        texel=np.unique(observed.texel, return_inverse=True)[1].astype(np.int64),
        frame=observed.frame.astype(np.int64),
        position=position,
        radiance=observed.radiance,
        noise=np.hypot(observed.noise[:, None], contrast),
        cell=_CELL_PIXELS * _pixel_size(position, observed.frame, camera_of),
    )
    if len(footprints) > 1:
        times = _TIMES_FOR_CURVED
        mixture = mixture._replace(per_lobe=times * mixture.per_lobe, lights=times * mixture.lights)
    widths = (_FOOTPRINT, *_OTHER_WIDTHS_PX)[: len(footprints)]
    likely = [_likely(width, smoothing) for width in widths]
    incoming = None if irradiance is None else irradiance[observed.texel]
    parts = [SampledPart(lit, observed, footprints, incoming, doubt)]
    return SampledObject(parts, samples, widths, likely, mixture), len(observed.texel)


def fit_kinds(
    sampled: SampledObject, kinds: Sequence[int], seed: int, repeats: int = 1
) -> dict[int, FittedKind]:
    """The lobe of the first kind, and where that shows, those of the others from the same rays."""
    bases = [
        [sampled.basis(width, number) for number in range(3 * seed, 3 * seed + 3)]
        for width in range(len(sampled.widths))
    ]
    blurs = [
        _deviation_of_normal(*(part.footprints[width] for part in sampled.parts))
        for width in range(len(sampled.widths))
    ]
    found: dict[int, FittedKind] = {}
    before: FittedKind | None = None
    for kind in kinds:
        of_kind = [[partial(basis, kind) for basis in three] for three in bases]
        candidates = [
            Candidate(first, second, third, blur, likely)
            for (first, second, third), blur, likely in zip(
                of_kind, blurs, sampled.likely, strict=True
            )
        ]
        before = found[kind] = fit_lobe(sampled.samples, candidates, repeats, before)
        if not before.lobe.evidence > SOME_EVIDENCE:
            break
    return found


def fit_views(
    lobe: int,
    sampled: Callable[[], SampledObject],
    seed: int,
    first: LobeEstimate | None = None,
    *,
    metal: bool = False,
) -> tuple[LobeEstimate, Conductor | None]:
    """The lobe, of a kind (``brdf``), and the metal that explains the samples better, if one does,
    with more rays as well; where S is not known none is looked for.

    sampled: asked for where something is left to be traced. first: the fit with the rays of
    ``first_seed(seed)``, if there is one. metal: it is known to be one.
    """

    def fitted(own_seed: int, repeats: int) -> LobeEstimate:
        return fit_kinds(sampled(), [lobe], own_seed, repeats)[lobe].lobe

    found = repeated_where_noisy(first or fitted(first_seed(seed), 1), fitted, seed)
    # The brightest dielectric, as far as rays tell, explains so much of what a mirror shows.
    is_brightest = found.psi + min(found.of_rays[1], MAX_PSI_ERROR) >= 1
    explained = 1 - (1 - F0_OF_PSI) ** 2 if is_brightest else 1.0
    shows = found.evidence > explained * SOME_EVIDENCE
    bright = shows and found.psi + 2 * found.psi_error > 1
    if not (bright or metal) or sampled().irradiance is None:
        return found, None
    conductor = _metal_of(lobe, sampled(), found, range(3 * seed, 3 * seed + 2), certain=metal)
    if conductor and not metal:
        first_of_more = 3 * (_SEED_OF_METAL + seed)
        more = range(first_of_more, first_of_more + 2 * _MORE_FOR_METAL)
        conductor = _metal_of(lobe, sampled(), found, more)
    return found, conductor


def _metal_of(
    lobe: int,
    held: SampledObject,
    found: LobeEstimate,
    seeds: Sequence[int],
    *,
    certain: bool = False,
) -> Conductor | None:
    """The metal that explains the samples better than the dielectric that was ``found``, if one
    does, by two bases from the rays of half of the ``seeds`` each."""
    assert held.irradiance is not None
    samples, kind = held.samples, of_metal(lobe)
    one, other = (_mean_of([held.basis(0, seed) for seed in seeds[half::2]]) for half in range(2))
    return conductor_of(
        samples.radiance, samples.texel, held.irradiance,
        (partial(one, kind), partial(other, kind)), found, certain=certain,
        of_dielectric=None if kind == lobe else (partial(one, lobe), partial(other, lobe)),
    )  # fmt: skip


def _mean_of(bases: Sequence[Basis]) -> Basis:
    def basis(kind: int, phis: Sequence[float]) -> tuple[Float, Float]:
        of_base, of_slope = zip(*(one(kind, phis) for one in bases), strict=True)
        return np.mean(of_base, axis=0), np.mean(of_slope, axis=0)

    return bases[0] if len(bases) == 1 else basis


def of_metal(lobe: int) -> int:
    """The kind of lobe that metals have in a scene whose other surfaces have this one."""
    return PAPER if lobe == PAPER else CONDUCTOR


def with_what_shows_through(
    lobe: int, sampled: Callable[[], SampledObject], index: int, seed: int, found: LobeEstimate
) -> LobeEstimate:
    """A lobe that would be measured, held against what is seen through the object ``index``: what
    shows through a thing for sure contradicts its being a surface."""
    if verdict_on_views(found, True).status != "measured":
        return found
    held = sampled()
    basis = partial(held.basis(0, 3 * (_SEED_OF_THROUGH + seed)), lobe)
    through = seen_through(held.samples, held.behind(index), basis, found.phi, found.psi).at_least
    return found._replace(contradiction=max(found.contradiction, through))


def tint_of(metal: Conductor) -> Float:
    """(3, 1): its reflectance in units of that of the channel that it reflects most of."""
    return (np.array(metal.f0, np.float32) / np.float32(max(metal.f0)))[:, None]


def metal_if_opaque(
    lobe: int,
    sampled: Callable[[], SampledObject],
    index: int,
    seed: int,
    found: LobeEstimate,
    metal: Conductor,
) -> tuple[LobeEstimate, Conductor | None]:
    """The ``metal`` that the object ``index`` would be; None where what is behind it shows through
    it, as it does through a pane: then the dielectric that was ``found`` is contradicted by that.
    Before and behind a pane a room may look alike."""
    held, kind = sampled(), of_metal(lobe)
    of_kind = held.basis(0, 3 * (_SEED_OF_THROUGH + seed))
    strongest = max(metal.f0)
    tint = tint_of(metal)

    def basis(phis: Sequence[float]) -> tuple[Float, Float]:
        base, slope = of_kind(kind, phis)
        return base, tint * slope

    given = metal.phi, strongest / F0_OF_PSI, 1 / F0_OF_PSI
    through = seen_through(held.samples, held.behind(index), basis, *given).at_least
    if through <= MOST_CONTRADICTED:
        return found, metal
    return found._replace(contradiction=max(found.contradiction, through)), None


def _footprints(
    lit: LitScene, observed: Observations, camera_of: Callable[[int], Camera], index: int
) -> tuple[Observations, list[SurfacePoints]]:
    """The observations whose footprint lies on the object as a whole, of texels that several frames
    see; and the footprints' points, for the usual width and, on curved objects, for others."""

    def whole(some: Observations, width: float) -> tuple[Long, SurfacePoints]:
        kept, points = _points(lit, some, camera_of, index, width * RINGS)
        enough = _several_views(some.texel[kept])
        return kept[enough], points.take(np.flatnonzero(np.repeat(enough, len(RINGS))))

    # What the samples spread over, in pixels: the footprint of a single texel's, and the square
    # that others are the mean of.
    usual, side = _FOOTPRINT, observed.side[0]
    if side > 1:
        pixel = _pixel_size(lit.texels.position[observed.texel], observed.frame, camera_of)
        square = side * math.sqrt(float(np.median(lit.texels.area[observed.texel])) / 12)
        usual = math.hypot(_FOOTPRINT, square / pixel)
    kept, points = whole(observed, usual)
    observed = observed.take(kept)
    if not len(kept) or _deviation_of_normal(points) < _CURVED:
        return observed, [points]
    within = {width: whole(observed, width)[0] for width in (_FOOTPRINT, *_OTHER_WIDTHS_PX)}
    for count in range(len(_OTHER_WIDTHS_PX), 0, -1):
        widths = (_FOOTPRINT, *_OTHER_WIDTHS_PX[:count])
        inner = reduce(np.intersect1d, [within[width] for width in widths])
        inner = inner[_several_views(observed.texel[inner])]
        if len(inner) >= max(_KEPT * len(kept), MIN_OBSERVATIONS):
            observed = observed.take(inner)
            return observed, [whole(observed, width)[1] for width in widths]
    return observed, [points]


def _likely(width: float, smoothing: float) -> float:
    """Of a footprint of so many pixels, in pictures smoothed by ``smoothing`` pixels (NaN: nobody
    knows, and all are alike)."""
    if math.isnan(smoothing):
        return 1.0
    expected = math.hypot(_FOOTPRINT, smoothing)
    return math.exp(-0.5 * (math.log(width / expected) / _SPREAD_OF_WIDTHS) ** 2)


def _clear_of_noise(observed: Observations) -> Bool:
    """Samples of texels that are, on the mean, well above the noise floor of the frame."""
    if not len(observed.texel):
        return np.zeros(0, np.bool_)
    texel = np.unique(observed.texel, return_inverse=True)[1]
    count = np.bincount(texel)
    mean = [np.bincount(texel, channel) / count for channel in observed.radiance.T]
    return np.asarray(np.min(mean, axis=0)[texel] > ABOVE_NOISE * observed.noise, np.bool_)


def _several_views(texel: Int) -> Bool:
    number = np.unique(texel, return_inverse=True)[1]
    return np.asarray(np.bincount(number)[number] >= MIN_VIEWS, np.bool_)


def _pixel_size(position: Float, frame: Int, camera_of: Callable[[int], Camera]) -> float:
    """Median size of a pixel on the surface, in metres."""
    sizes = []
    for number in np.unique(frame):
        camera = camera_of(int(number))
        distance = np.linalg.norm(position[frame == number] - camera.eye, axis=1)
        sizes.append(distance / camera.intrinsics[0])
    return float(np.median(np.concatenate(sizes)))


def _deviation_of_normal(*points: SurfacePoints) -> float:
    """Median standard deviation of the normal, in radians per axis, over a sample's points."""
    normal = np.concatenate([some.normal for some in points]).reshape(-1, len(RINGS), 3)
    spread = ((normal - normal.mean(axis=1, keepdims=True)) ** 2).sum(axis=2).mean(axis=1)
    return float(np.sqrt(np.median(spread) / 2))


def _points(
    lit: LitScene,
    observed: Observations,
    camera_of: Callable[[int], Camera],
    index: int,
    offsets: Double,
) -> tuple[Long, SurfacePoints]:
    """The observations whose footprint lies on the object as a whole, and the surface points of
    each, at ``offsets`` (K, 2) in pixels, in order of the observations."""
    kept, parts = [], []
    for frame in np.unique(observed.frame):
        which = np.flatnonzero(observed.frame == frame)
        camera = camera_of(int(frame))
        pixels = camera.project(lit.texels.position[observed.texel[which]])
        whole, points = sub_pixel_points(lit, camera, pixels, index, offsets)
        kept.append(which[whole])
        parts.append(points)
    unordered = np.concatenate(kept)
    order = np.argsort(unordered, kind="stable")
    each = (len(offsets) * order[:, None] + np.arange(len(offsets))).ravel()
    return unordered[order], SurfacePoints.joined(parts).take(each)
