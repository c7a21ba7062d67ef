"""How strong the sources of light outside are: least squares on the logarithms of what texels
reflect, pi L_d = albedo S, where S is what was seen and each source's share times its strength.
L_d holds the specular light that all frames see as well: where it is told what a usual dielectric
would mirror to them, M,

    pi L_d = albedo S + m pi M

with m of each segment about that of the scene, ``gloss_of_scene``, without which dark surfaces make
lamps too dim, and most so in the colours that they reflect least.

On one segment (a facing of one object) the albedo varies about one value. Outliers weigh as under
Student's t, and each segment by how much its texels scatter. What clips is a lower bound. Before
the evidence albedos are about what is usual, and nothing reflects much more than it receives: which
fixes the level of the light where next to nothing that was seen lights the scan.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import sparse

from usdbrdf import calibration
from usdbrdf.model.arrays import Array, Bool, Double, Int, Long
from usdbrdf.shading.clipped_emitters import ALONE, ERROR_ALONE


class Asked(NamedTuple):
    """N texels that are asked: their numbers, segments counted from 0 and objects, what they
    reflect (pi L_d, W/m^2; where ``clipped`` the largest channel reflects no less), (N, 3), S of
    what was seen, and pi times what a usual dielectric would mirror to the frames, (N, 3)."""

    texel: Long
    segment: Int
    owner: Int
    reflected: Double
    clipped: Bool
    irradiance: Double
    mirrored: Double

    def of(self, which: Array) -> Asked:
        """Some of them, with their segments counted anew."""
        some = Asked._make(values[which] for values in self)
        segment = np.unique(some.segment, return_inverse=True)[1]
        return some._replace(segment=segment.astype(np.int32))


class Sources(NamedTuple):
    """K sources of unknown strength: what each brings per unit of it to the texels asked, (K, N);
    the logarithm of its strength before the evidence, mean (K, 3) and deviation (K,); its family,
    (K,), those of one are as far from that together as one of them may be, -1 for one that errs by
    itself; and pairs of neighbours, which are alike, (P, 2), by how much these are apart, (P,); and
    the gloss of segments, the share that they mirror of what usual dielectrics would: mean and
    standard deviation; stray, the share of the mean S that may reach any texel unknown."""

    share: Double
    mean: Double
    deviation: Double
    family: Long
    pairs: Long
    apart: Double
    gloss: tuple[float, float] = (0.0, 0.0)
    stray: float = 0.0

    def precision(self) -> Double:
        """(K,): how much what is thought before the evidence counts for each."""
        size = np.bincount(self.family + 1)[self.family + 1]
        return np.asarray(self.deviation**-2.0 / np.where(self.family < 0, 1, size))

    def irradiance(self, log_radiance: Double) -> Double:
        """(N, 3) W/m^2 of all of them."""
        return np.asarray(np.einsum("kn,kc->nc", self.share, np.exp(log_radiance)))


_FREEDOM = calibration.number("outside.student_freedom")
_INDEPENDENT = calibration.number("outside.independent")
_USUAL_ALBEDO = calibration.pair("outside.albedo")
# How glossy a scene may be.
_GLOSS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Standard deviation of a gloss that is given.
_GIVEN = 0.01
_OF_SEGMENT = calibration.number("outside.albedo_of_segment")
_WHITEST, _AS_WHITE = calibration.pair("outside.whitest")
_ITERATIONS = 40
# A source so much brighter in one channel than in another, a logarithm, is looked for from each.
_APART = 1.0
_LEAST_NOISE = calibration.number("outside.least_noise")


class Solution(NamedTuple):
    """log_radiance (K, 3) of the sources, log_albedo (M, 3) of the segments, the logarithm of the
    mean albedo, (3,), and the gloss of the segments, (M, 3)."""

    log_radiance: Double
    log_albedo: Double
    mean: Double
    gloss: Double


def solved(
    asked: Asked, sources: Sources, start: Solution | None = None, iterations: int = _ITERATIONS
) -> Solution:
    """The strengths that explain best what the texels reflect."""
    # Segment by segment, so that sums over one are of neighbours.
    order = np.argsort(asked.segment, kind="stable")
    asked = Asked._make(values[order] for values in asked)
    sources = sources._replace(share=np.ascontiguousarray(sources.share[:, order]))
    if start is None:
        start = _begun(asked, sources, sources.mean)
    found = start
    # Which channel it is that clips, what does not clip tells first.
    for counted in (~asked.clipped[:, None] & np.ones(3, np.bool_), None):
        if counted is None:
            light = asked.irradiance + sources.irradiance(found.log_radiance)
            brightest = (np.log(light) + found.log_albedo[asked.segment]).argmax(axis=1)
            counted = ~asked.clipped[:, None] | (np.arange(3) == brightest[:, None])
        channels = [
            _solved_channel(asked, sources, found, c, counted[:, c], iterations) for c in range(3)
        ]
        found = Solution(*(np.stack(parts, axis=-1) for parts in zip(*channels, strict=True)))
    return found


def likeliest(asked: Asked, sources: Sources, *others: Double) -> Solution:
    """As ``solved``, but each channel from several starts, since far from a strength the texels
    that tell it are outliers: from the prior's means, from ``others`` (K, 3), logarithms of
    radiance, and from what the other channels told."""
    found = solved(asked, sources)
    least = _misfit(asked, sources, found)

    def tried(log_radiance: Double) -> None:
        nonlocal found, least
        other = solved(asked, sources, _begun(asked, sources, log_radiance))
        misfit = _misfit(asked, sources, other)
        better = ~(misfit >= least)
        pairs = zip(other, found, strict=True)
        found = Solution(*(np.where(better, new, kept) for new, kept in pairs))
        least = np.where(better, misfit, least)

    for start in others:
        tried(start)
    apart = np.ptp(found.log_radiance, axis=1)
    if (apart > _APART).any():
        for channel in range(3):
            tried(np.repeat(found.log_radiance[:, channel : channel + 1], 3, axis=1))
    return found


def _begun(asked: Asked, sources: Sources, log_radiance: Double) -> Solution:
    """With sources of these strengths (K, 3), from which to go on."""
    rest = np.log(asked.reflected) - np.log(asked.irradiance + sources.irradiance(log_radiance))
    count = int(asked.segment.max()) + 1
    albedo = [medians_of_segments(channel, asked.segment, count) for channel in rest.T]
    gloss = np.full((count, 3), sources.gloss[0])
    return Solution(
        log_radiance.copy(), np.stack(albedo, axis=-1), np.full(3, _USUAL_ALBEDO[0]), gloss
    )


def _misfit(asked: Asked, sources: Sources, found: Solution) -> Double:
    """(3,) minus the logarithm of the likelihood of what the texels reflect, times what was thought
    of sources and albedos before the evidence, up to a constant."""
    off = (found.log_radiance - sources.mean) ** 2 * sources.precision()[:, None]
    one, other = sources.pairs.T
    beside = (found.log_radiance[one] - found.log_radiance[other]) / sources.apart[:, None]
    albedo = (found.log_albedo - found.mean) / _OF_SEGMENT
    over = np.maximum(found.log_albedo - np.log(_WHITEST), 0) / _AS_WHITE
    usual = (found.mean - _USUAL_ALBEDO[0]) / _USUAL_ALBEDO[1]
    gloss = (found.gloss - sources.gloss[0]) / max(sources.gloss[1], _GIVEN)
    of_segments = albedo**2 + over**2 + gloss**2
    prior = off.sum(axis=0) + (beside**2).sum(axis=0) + of_segments.sum(axis=0) + usual**2
    model = _model(asked, sources, found)
    return np.asarray(0.5 * prior + _unlikely(asked, model, sources.stray))


def _model(asked: Asked, sources: Sources, found: Solution) -> Double:
    """(N, 3) W/m^2: what the texels reflect by what was ``found``."""
    scattered = asked.irradiance + sources.irradiance(found.log_radiance)
    model = np.exp(found.log_albedo)[asked.segment] * scattered
    return np.asarray(model + found.gloss[asked.segment] * asked.mirrored)


def _unlikely(asked: Asked, model: Double, stray: float) -> Double:
    """(3,) minus the logarithm of the likelihood, under Student's t, of what the texels reflect
    where the ``model`` (N, 3) is that, up to a constant."""
    number, plain = int(asked.segment.max()) + 1, ~asked.clipped
    size = np.bincount(asked.segment[plain], minlength=number)
    counts = np.minimum(1, _INDEPENDENT / np.maximum(size, 1))[asked.segment[plain]]
    misfit = np.zeros(3)
    for channel, residual in enumerate(np.log(asked.reflected / model).T):
        noise = _noise_of_segments(asked, residual, number)[asked.segment]
        noise = np.hypot(noise, stray * model[:, channel].mean() / model[:, channel])
        square = (residual / noise)[plain] ** 2
        each = np.log(noise[plain]) + 0.5 * (_FREEDOM + 1) * np.log1p(square / _FREEDOM)
        misfit[channel] = counts @ each
    return misfit


def _solved_channel(
    asked: Asked, sources: Sources, start: Solution, channel: int, counted: Bool, iterations: int
) -> tuple[Double, Double, Double, Double]:
    """One channel's part of ``solved``: Gauss-Newton steps on the weighted squares of the texels
    that are ``counted`` (N,); all are in the order of their segments."""
    known, observed = asked.irradiance[:, channel], np.log(asked.reflected[:, channel])
    mirrored = asked.mirrored[:, channel]
    g, albedo, gloss = (
        part[:, channel].copy() for part in (start.log_radiance, start.log_albedo, start.gloss)
    )
    mean = float(start.mean[channel])
    num_sources, num_segments = len(g), len(albedo)
    size = np.bincount(asked.segment, minlength=num_segments)
    effective = np.minimum(1, _INDEPENDENT / np.maximum(size, 1))[asked.segment]
    # A texel depends on all sources, and on the albedo and the gloss of one segment.
    of_albedo = num_sources + np.arange(num_segments)
    of_gloss = of_albedo + num_segments

    first, every = np.append(0, np.cumsum(size)), np.arange(len(known))
    # A row for each texel: what is done with it then lies together.
    share = np.ascontiguousarray(sources.share.T)
    by_source, weighted = np.zeros((2, *share.shape))  # their memory is asked for once

    sums = sparse.csr_matrix((np.zeros(len(every)), every, first), (num_segments, len(every)))

    def gathered(factor: Double, values: Double) -> Double:
        """(M, ...): sums of factor (N,) times values (N, ...) over the texels of each segment."""
        sums.data[:] = factor  # making another matrix takes longer than the sums
        return np.asarray(sums @ values)

    for _ in range(iterations):
        scattered = known + share @ np.exp(g)
        over_albedo = np.exp(-albedo)[asked.segment]
        total = scattered + gloss[asked.segment] * over_albedo * mirrored
        residual = observed - np.log(total) - albedo[asked.segment]
        # What clips reflects at least as much: it says something where the model says less.
        counts = counted & (~asked.clipped | (residual > 0))
        noise = _noise_of_segments(asked, residual, num_segments)[asked.segment]
        noise = np.hypot(noise, sources.stray * total.mean() / total)
        weight = (_FREEDOM + 1) / (_FREEDOM + (residual / noise) ** 2) / noise**2
        weight = weight * effective * counts
        np.divide(share, total[:, None], out=by_source)
        by_source *= np.exp(g)
        by_albedo, by_gloss = scattered / total, over_albedo * mirrored / total
        rows = num_sources + 2 * num_segments + 1
        curvature, gradient = np.zeros((rows, rows)), np.zeros(rows)
        np.multiply(by_source, np.sqrt(weight)[:, None], out=weighted)
        curvature[:num_sources, :num_sources] = weighted.T @ weighted
        gradient[:num_sources] = (weight * residual) @ by_source
        parts = by_albedo * weight, by_gloss * weight
        for place, part in zip((of_albedo, of_gloss), parts, strict=True):
            if not part.any():  # nothing is mirrored
                continue
            both = gathered(part, by_source)
            curvature[place, :num_sources], curvature[:num_sources, place] = both, both.T
            gradient[place] = gathered(part, residual)
        curvature[of_albedo, of_albedo] = gathered(parts[0], by_albedo)
        curvature[of_gloss, of_gloss] = gathered(parts[1], by_gloss)
        both = gathered(parts[0], by_gloss)
        curvature[of_albedo, of_gloss] = curvature[of_gloss, of_albedo] = both
        _add_priors(curvature, gradient, sources, channel, (g, albedo, gloss, mean))
        # What would be less glossy than not at all stays as it is.
        held = of_gloss[(gloss <= 0) & (gradient[of_gloss] < 0)]
        curvature[held], curvature[:, held], gradient[held] = 0, 0, 0
        curvature[held, held] = 1
        damped = curvature + 1e-3 * np.diag(np.diag(curvature))
        step = np.clip(np.linalg.solve(damped, gradient), -1, 1)
        g += step[:num_sources]
        albedo += step[of_albedo]
        gloss = np.maximum(gloss + step[of_gloss], 0)
        mean += float(step[-1])
        if np.abs(step).max() < 1e-4:
            break
    return g, albedo, np.array(mean), gloss


def _noise_of_segments(asked: Asked, residual: Double, count: int) -> Double:
    """(M,) how much the residuals (N,) of each segment scatter: plain walls tell more than what is
    patterned."""
    off, segment = np.abs(residual[~asked.clipped]), asked.segment[~asked.clipped]
    return np.maximum(_LEAST_NOISE, 1.4826 * medians_of_segments(off, segment, count))


def medians_of_segments(values: Double, segment: Int, count: int) -> Double:
    """(M,) of values (N,) those of each segment; of one without any that of all."""
    # One sort is much faster than a median of each.
    ordered, size = values[np.lexsort((values, segment))], np.bincount(segment, minlength=count)
    has = size > 0
    middle = np.full(count, 0.0 if has.all() else np.median(values))
    first = (np.cumsum(size) - size)[has]
    lower, upper = first + (size[has] - 1) // 2, first + size[has] // 2
    middle[has] = (ordered[lower] + ordered[upper]) / 2
    return middle


def _add_priors(
    curvature: Double,
    gradient: Double,
    sources: Sources,
    channel: int,
    at: tuple[Double, Double, Double, float],
) -> None:
    """What is known of sources, albedos and gloss before the evidence."""
    g, albedo, gloss, mean = at
    k, last = len(g), len(gradient) - 1
    index = np.arange(k)
    off = sources.mean[:, channel] - g
    precision = sources.precision()
    curvature[index, index] += precision
    gradient[:k] += precision * off
    pull = sources.apart**-2.0
    for one, other in (sources.pairs.T, sources.pairs.T[::-1]):
        np.add.at(curvature, (one, one), pull)
        np.add.at(curvature, (one, other), -pull)
        np.add.at(gradient, one, -pull * (g[one] - g[other]))
    segment = np.arange(k, k + len(albedo))
    glossy = segment + len(albedo)
    usual, spread = sources.gloss[0], max(sources.gloss[1], _GIVEN)
    curvature[glossy, glossy] += spread**-2
    gradient[glossy] += (usual - gloss) / spread**2
    off = albedo - mean
    precision_of = _OF_SEGMENT**-2
    curvature[segment, segment] += precision_of
    curvature[segment, last] -= precision_of
    curvature[last, segment] -= precision_of
    curvature[last, last] += precision_of * len(albedo) + _USUAL_ALBEDO[1] ** -2
    gradient[segment] -= precision_of * off
    gradient[last] += precision_of * off.sum() + (_USUAL_ALBEDO[0] - mean) / _USUAL_ALBEDO[1] ** 2
    # Nothing reflects more than it receives.
    over = np.maximum(albedo - np.log(_WHITEST), 0)
    curvature[segment, segment] += (over > 0) * _AS_WHITE**-2
    gradient[segment] -= over * _AS_WHITE**-2


def gloss_of_scene(asked: Asked, sources: Sources, sent_on: Double, *others: Double) -> Sources:
    """The sources in a scene as glossy as it is likeliest to be, under Student's t, with all its
    segments about that, give or take as much; and with what surfaces send on of them, ``sent_on``
    (K, N) if all were usual dielectrics. What these send on of the light that was seen is in it:
    frames saw it mirrored. others (K, 3): as of ``likeliest``."""

    def with_gloss(gloss: float) -> Sources:
        return sources._replace(share=sources.share + gloss * sent_on, gloss=(gloss, gloss))

    def cost(gloss: float) -> float:
        glossy = with_gloss(gloss)
        found = likeliest(asked, glossy, *others)
        return float(_unlikely(asked, _model(asked, glossy, found), sources.stray).sum())

    return with_gloss(min(_GLOSS, key=cost))


_PLAINEST, _LEAST_DIFFERING = calibration.pair("lamps.plain_views")


def doubt_by_views(differing: Double) -> Double:
    """(N,): how many times as far as those of the plainest of them the views of texels differ,
    ``differing`` (N,), at least 1, as where that is not known (NaN). What looks another way from
    each side mirrors, or mixes in a pixel what lies side by side: the middle of that is what a
    plain reflector shows by chance alone."""
    known = np.isfinite(differing)
    plain = float(np.quantile(differing[known], _PLAINEST)) if known.any() else 0.0
    return np.where(known, np.maximum(differing / max(plain, _LEAST_DIFFERING), 1), 1.0)


_MOSTLY_INFERRED = calibration.number("outside.level_unknown")
_OVER_ONE = calibration.number("outside.over_one")


def levelled(
    asked: Asked, sources: Sources, found: Solution, differing: Callable[[], Double] | None = None
) -> Solution:
    """The same, but where nearly all light is inferred: contrasts then leave its level and colour
    open. It is taken to be white as a whole, and as bright as it must be for hardly a texel to
    reflect more than it receives; those of objects that look another way from each side, as metals
    do, tell less of that. differing: tells that of objects, as ``AssetMaps.differing``; None if
    all are alike."""
    inferred = sources.irradiance(found.log_radiance)
    share = np.median(inferred.sum(axis=1) / (inferred + asked.irradiance).sum(axis=1))
    if share < _MOSTLY_INFERRED:
        return found
    # What is so much brighter than the rest shines by itself.
    lamp = (found.log_albedo - found.mean).max(axis=1) > _LAMP * _OF_SEGMENT
    plain = ~asked.clipped & ~lamp[asked.segment]
    if not plain.any():
        return found
    colour = np.log(inferred.mean(axis=0))
    shift = colour.mean() - colour
    reflected, inferred, known = (
        light[plain] for light in (asked.reflected, inferred * np.exp(shift), asked.irradiance)
    )
    alike = (np.ones(len(asked.owner)) if differing is None else differing()[asked.owner])[plain]
    told = np.isfinite(alike)
    # What few frames show tells no more than the usual.
    alike = np.where(told, alike, np.median(alike[told]) if told.any() else 1.0)
    weight = doubt_by_views(alike) ** -2.0
    for factor in np.geomspace(1, _BRIGHTEST, _STEPS):
        over = (reflected > known + factor * inferred).any(axis=1)
        if weight @ over < _OVER_ONE * weight.sum():
            break
    shift = shift + np.log(factor)
    return found._replace(log_radiance=found.log_radiance + shift)


_BRIGHTEST, _STEPS, _LAMP = 4.0, 57, 3.0
_BLOCKS = 10
# Parts of what tells a source alone.
_PARTS = 8


def jackknife(
    asked: Asked, sources: Sources, found: Solution, certain: Bool | None = None
) -> Double:
    """(K, 3) standard errors of the logarithms, if objects (segments where they are few) err as a
    whole; infinite where there is but one.

    certain  (K,): sources that shine for certain, so that only how much is asked. What tells one of
             these alone errs by parts, and as a whole by lamps.alone
    """
    few = len(np.unique(asked.owner)) < _BLOCKS
    _, whole = np.unique(asked.segment if few else asked.owner, return_inverse=True)
    error = _without_each(asked, sources, found, whole % _BLOCKS)
    if certain is None or not certain.any():
        return error
    told = _told(asked, sources, found)
    for k in np.flatnonzero(certain):
        of_whole = np.bincount(whole, told[k])
        one, total = int(of_whole.argmax()), of_whole.sum()
        share = of_whole[one] / max(total, 1e-300)
        if share > ALONE and total > sources.deviation[k] ** -2:
            parts = _without_each(asked, sources, found, _in_parts(asked, whole, one))[k]
            error[k] = np.hypot(parts, ERROR_ALONE * share)
    return error


def _without_each(asked: Asked, sources: Sources, found: Solution, block: Long) -> Double:
    """(K, 3): how far the logarithms move without each of the blocks (N,), as standard errors."""
    moved, blocks = np.zeros_like(found.log_radiance), np.unique(block)
    if len(blocks) < 2:
        return np.full_like(found.log_radiance, np.inf)
    for number in blocks:
        kept = block != number
        some, numbers = asked.of(kept), np.unique(asked.segment[kept])
        start = found._replace(log_albedo=found.log_albedo[numbers], gloss=found.gloss[numbers])
        part = solved(some, sources._replace(share=sources.share[:, kept]), start, 8)
        moved += (part.log_radiance - found.log_radiance) ** 2
    return np.asarray(np.sqrt((1 - 1 / len(blocks)) * moved))


def pull_of_prior(asked: Asked, sources: Sources, found: Solution) -> Double:
    """(K, 3): how far the logarithms would be off if what was thought of the sources before the
    evidence were wrong by its own deviation. Next to nothing for what texels tell."""
    otherwise = sources._replace(mean=sources.mean + sources.deviation[:, None])
    off: Double = np.abs(solved(asked, otherwise, found, 8).log_radiance - found.log_radiance)
    return off


def _told(asked: Asked, sources: Sources, found: Solution) -> Double:
    """(K, N): how much each texel adds to what is known of the logarithm of a source's strength,
    where the albedo of its segment is free."""
    light = asked.irradiance + sources.irradiance(found.log_radiance)
    brought = sources.share * np.exp(found.log_radiance).mean(axis=1)[:, None]
    part = brought / light.mean(axis=1)
    residual = np.log(asked.reflected / light).mean(axis=1)
    number = int(asked.segment.max()) + 1
    size = np.maximum(np.bincount(asked.segment, minlength=number), 1)
    residual -= (np.bincount(asked.segment, residual, number) / size)[asked.segment]
    noise = _noise_of_segments(asked, residual, number)
    precision = np.minimum(1, _INDEPENDENT / size) / noise**2
    told: Double = np.empty_like(part)
    for k, own in enumerate(part):
        mean = np.bincount(asked.segment, own, number) / size
        told[k] = (own - mean[asked.segment]) ** 2 * precision[asked.segment]
    return told


def _in_parts(asked: Asked, whole: Long, one: int) -> Long:
    """Blocks (N,) of the objects, ten in all, but of the ``one`` its parts: texels of a segment
    with numbers next to each other lie together."""
    own = np.flatnonzero(whole == one)
    order = own[np.lexsort((asked.texel[own], asked.segment[own]))]
    size = np.bincount(asked.segment[order], minlength=int(asked.segment.max()) + 1)
    place = np.arange(len(order)) - (np.cumsum(size) - size)[asked.segment[order]]
    block = whole % _BLOCKS
    block[order] = _BLOCKS + place * _PARTS // size[asked.segment[order]]
    return block
