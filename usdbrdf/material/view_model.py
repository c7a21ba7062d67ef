"""What many views of the same texels say of a lobe, with the errors that photographs really have,
those that samples of a frame share among them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import linalg, sparse

from usdbrdf import calibration
from usdbrdf.kernel import loop
from usdbrdf.model.arrays import Bool, Double, Float, Long


@dataclass(frozen=True, kw_only=True)
class FrameEffects:
    """What the samples of one frame share: samples (M,), kind (n,) of each shared error, and which
    channels of the samples have it, (3 M, n)."""

    samples: Long
    kind: Long
    has: Bool


def effects_of_frames(every: Sequence[tuple[Long, int | None]], frame: Long) -> list[FrameEffects]:
    """Of each kind, the error that each sample has (-1: none), and the one channel that it is for
    (None: all three alike); and each sample's frame (P,), of which there is none that shares an
    error with another, and none that shows a texel twice."""
    frames = []
    for number in np.unique(frame):
        samples = np.flatnonzero(frame == number)
        kinds, columns = [], []
        for kind, (which, channel) in enumerate(every):
            own = which[samples]
            shared = np.unique(own[own >= 0])
            of_channel = np.array([channel in (None, c) for c in range(3)])
            has = (own[:, None, None] == shared) & of_channel[:, None]
            kinds.append(np.full(len(shared), kind))
            columns.append(has.reshape(3 * len(samples), len(shared)))
        kind_of, has_it = np.concatenate(kinds), np.concatenate(columns, axis=1)
        if len(kind_of):
            frames.append(FrameEffects(samples=samples, kind=kind_of, has=has_it))
    return frames


@dataclass(frozen=True, kw_only=True)
class _Frame:
    """At the present variances, with L L' = E of the frame: inverse_root L^-1 (n, n), along
    L^-1 Z' (n, 3 M), of_texels L^-1 B (n, 3 M), whose columns are the rows ``places`` of S."""

    samples: Long
    kind: Long
    places: Long
    inverse_root: Double
    along: Double
    of_texels: Double


class SharedErrors:
    """The shared errors at given variances."""

    def __init__(
        self,
        effects: Sequence[FrameEffects],
        deviation: Double,
        level: Double,
        weight: Double,
        texel: Long,
        of_texels: Double,
    ) -> None:
        """deviation (kinds,); level (P, 3), what an error of 1 adds; weight (P, 3, 3), W; texel
        (P,); of_texels (texels, 3, 3), T."""
        self._kinds, self._count = len(deviation), len(level)
        count = len(of_texels)
        blocks = np.zeros((count, 3, count, 3))
        blocks[np.arange(count), :, np.arange(count)] = of_texels
        dense = blocks.reshape(3 * count, 3 * count)
        self._frames = []
        for one in effects:
            samples = one.samples
            adds = one.has * level[samples].reshape(-1, 1)
            weighted = (weight[samples] @ adds.reshape(len(samples), 3, -1)).reshape(adds.shape)
            normal = adds.T @ weighted
            normal[np.diag_indices_from(normal)] += 1 / deviation[one.kind] ** 2
            inverse_root, _ = linalg.lapack.dtrtri(np.linalg.cholesky(normal), lower=True)
            frame = _Frame(
                samples=samples,
                kind=one.kind,
                places=(3 * texel[samples][:, None] + np.arange(3)).ravel(),
                inverse_root=inverse_root,
                along=inverse_root @ adds.T,
                of_texels=inverse_root @ weighted.T,
            )
            _subtract(dense, frame.places, frame.of_texels.T @ frame.of_texels)
            self._frames.append(frame)
        self._root = linalg.cholesky(dense, lower=True, check_finite=False)

    def whitened(self, weighted: Double) -> Double:
        """(N, K), two columns of which have the product a' W Z A^-1 Z' W b; weighted (P, 3, K) is
        W a, of values a that are free of the texels' means."""
        sets = weighted.shape[2]
        of_texels = np.zeros((len(self._root), sets))
        parts = []
        for frame in self._frames:
            part = frame.along @ weighted[frame.samples].reshape(-1, sets)
            of_texels[frame.places] += frame.of_texels.T @ part
            parts.append(part)
        parts.append(linalg.solve_triangular(self._root, of_texels, lower=True, check_finite=False))
        return np.concatenate(parts)

    def added(self, whitened: Double) -> Double:
        """What the shared errors are expected to have added to the samples, (P, 3), given one
        ``whitened`` column (N,) of the samples' values."""
        added = np.zeros((self._count, 3))
        for frame, white in self._of_frames(whitened):
            added[frame.samples] = (frame.along.T @ white).reshape(-1, 3)
        return added

    def mean_squares(self, whitened: Double) -> Double:
        """The mean square expected of each kind of shared error, (kinds,), given the same."""
        covariance, _ = linalg.lapack.dpotri(self._root, lower=True)
        square, number = np.zeros(self._kinds), np.zeros(self._kinds)
        for frame, white in self._of_frames(whitened):
            effect = frame.inverse_root.T @ white
            coupling = frame.inverse_root.T @ frame.of_texels
            own = _symmetric_block(covariance, frame.places)
            variance = (frame.inverse_root**2).sum(axis=0)
            variance += ((coupling @ own) * coupling).sum(axis=1)
            square += np.bincount(frame.kind, effect**2 + variance, self._kinds)
            number += np.bincount(frame.kind, minlength=self._kinds)
        return square / np.maximum(number, 1)

    def _of_frames(self, whitened: Double) -> Iterator[tuple[_Frame, Double]]:
        """Each frame with its shared errors' part, the texels' part solved for, (n,)."""
        of_texels = linalg.solve_triangular(
            self._root, whitened[-len(self._root) :], lower=True, trans="T", check_finite=False
        )
        first = 0
        for frame in self._frames:
            white = whitened[first : first + len(frame.kind)]
            first += len(white)
            yield frame, white + frame.of_texels @ of_texels[frame.places]


@loop
def _subtract(matrix: Double, places: Long, block: Double) -> None:
    """matrix (N, N) -= block (n, n) in the rows and columns ``places`` (n,)."""
    for i in range(len(places)):
        for j in range(len(places)):
            matrix[places[i], places[j]] -= block[i, j]


@loop
def _symmetric_block(lower: Double, places: Long) -> Double:
    """Rows and columns ``places`` (n,) of a symmetric matrix whose lower half is given, (n, n)."""
    block = np.empty((len(places), len(places)))
    for i in range(len(places)):
        for j in range(i + 1):
            high, low = max(places[i], places[j]), min(places[i], places[j])
            block[i, j] = block[j, i] = lower[high, low]
    return block


_INDEPENDENT = calibration.number("errors.independent")
_OF_SPECULAR = calibration.number("errors.of_specular")
# Steps of expectation maximisation from the first guess on.
UPDATES = 4
# Where the search for the shared errors' standard deviations starts, and their least value.
_FIRST_GUESS, _LEAST = 0.02, 1e-4
# With more shared errors than this, cells are made larger, up to the object.
_MOST_EFFECTS = 2500
_TAIL = calibration.number("errors.student_freedom")
LEAST_DIFFUSE = calibration.number("errors.least_diffuse")
# Parts of space across an object within which errors are taken to hang together.
_PLACES = calibration.number("errors.places_across")


@dataclass(frozen=True, kw_only=True)
class ViewSamples:
    """P samples: texel (P,) counted from 0 without gaps, frame (P,), position (P, 3) in metres,
    radiance (P, 3); noise (P, 3), standard deviation of independent errors, the least there is;
    cell: side of the smaller cells of space whose samples share errors."""

    texel: Long
    frame: Long
    position: Float
    radiance: Float
    noise: Float
    cell: float

    @property
    def places(self) -> Long:
        """(P,): the part of space that each sample lies in, ``_PLACES`` across, counted from 0."""
        place = self.position - self.position.min(axis=0)
        part = np.floor(place * (_PLACES / max(float(place.max()), 1e-30)))
        part = np.minimum(part, _PLACES - 1).astype(np.int64)  # the farthest sample is in the last
        return np.unique(part, axis=0, return_inverse=True)[1].ravel()


class Reduced(NamedTuple):
    """K sets of values freed of the texels' means, (P, 3, K), the same weighted, and their part
    along the shared errors, whitened, (N, K)."""

    values: Double
    weighted: Double
    shared: Double

    def parts(self, count: int) -> list[Reduced]:
        """Equally many sets after each other."""
        split = (np.split(one, count, axis=-1) for one in self)
        return [Reduced._make(one) for one in zip(*split, strict=True)]


class ViewModel:
    """The model above at its present variances; ``update`` improves them."""

    def __init__(self, samples: ViewSamples) -> None:
        self._texel = samples.texel
        self._num_texels = int(samples.texel.max()) + 1
        # (texels, P): sums of each texel's samples.
        count = len(samples.texel)
        self._gather = sparse.csr_matrix((np.ones(count), (samples.texel, np.arange(count))))
        self._radiance = samples.radiance.astype(np.float64)
        self._noise = samples.noise.astype(np.float64)
        views = np.bincount(samples.texel)
        mean = np.stack([np.bincount(samples.texel, c) / views for c in self._radiance.T], axis=-1)
        mean = np.maximum(mean, LEAST_DIFFUSE * mean.mean(axis=1, keepdims=True))[samples.texel]
        self._mean, self._level = mean, mean
        self._specular = np.zeros_like(mean)
        # Of all samples, what is left for errors after each texel took its mean.
        self._freedom = count / (count - len(views))
        # What may be off alike in more ways than the shared errors say.
        self.groups = np.unique(samples.frame, return_inverse=True)[1], samples.places
        every = _effects(samples)
        self._effects = effects_of_frames(every, samples.frame)
        self._deviation = np.full(len(every), _FIRST_GUESS)
        self._own_deviation = _FIRST_GUESS
        self._scale = 1.0
        self._robust_weight = np.ones(count)
        self._factorise()

    @property
    def degrees_of_freedom(self) -> int:
        return 3 * (len(self._texel) - self._num_texels)

    @property
    def contradiction(self) -> float:
        """Relative standard deviation of what a frame's samples have in common, over the object or
        places of it, that neither texels' diffuse light nor the best lobe so far explains."""
        diffuse = self._level / (self._level + self._specular)
        frame, small, large, *_ = self._deviation
        return float(np.sqrt((frame**2 + small**2 + large**2) * (diffuse**2).mean()))

    def reduced(self, values: npt.NDArray[np.floating]) -> Reduced:
        """Prepare K sets of values at once, (P, 3, K), for ``product``."""
        rest = values - self._texel_means(self._weight @ values)[self._texel]
        weighted = self._weight @ rest
        return Reduced(values=rest, weighted=weighted, shared=self._shared.whitened(weighted))

    def product(self, a: Reduced, b: Reduced) -> Double:
        """a' C^-1 b of each of K sets, (K,), C being the covariance of the samples with the diffuse
        parts left free."""
        products: Double = np.einsum("pck,pck->k", a.values, b.weighted)
        products -= np.einsum("nk,nk->k", a.shared, b.shared)
        return products

    def sums_of_texels(self, values: Double) -> Double:
        """Sums over each texel's samples, (num_texels, K), of values (P, K)."""
        sums: Double = self._gather @ values
        return sums

    def solved(self, values: npt.NDArray[np.floating]) -> Double:
        """C^-1 of K sets of values, (P, 3, K), with the diffuse parts left free."""
        errors = [self._shared.added(one) for one in self.reduced(values).shared.T]
        return self.reduced(values - np.stack(errors, axis=-1)).weighted

    def update(self, non_diffuse: npt.NDArray[np.floating]) -> None:
        """One step of expectation maximisation, given I_nd (P, 3) of the best lobe so far."""
        rest = self._radiance - non_diffuse
        whitened = self.reduced(rest[..., None]).shared[:, 0]
        self._deviation = np.maximum(_LEAST, np.sqrt(self._shared.mean_squares(whitened)))
        left = self.reduced((rest - self._shared.added(whitened))[..., None])
        values, weighted = left.values[..., 0], left.weighted[..., 0]
        own_variance = 1 / self._own_precision
        own = (self._towards_level * values).sum(axis=1) * own_variance
        self._own_deviation = float(np.sqrt((self._robust_weight * (own**2 + own_variance)).mean()))
        alone = values - own[:, None] * self._level
        explained = (self._level**2 * own_variance[:, None] / self._variance).mean()
        self._scale *= float((alone**2 / self._variance).mean() * self._freedom + explained)
        distance = (values * weighted).sum(axis=1) * self._freedom / self._robust_weight
        self._robust_weight = (_TAIL + 3) / (_TAIL + distance)
        self._specular = np.maximum(non_diffuse, 0).astype(np.float64)
        diffuse = self._texel_means(self._weight @ rest[..., None])[self._texel, :, 0]
        self._level = np.maximum(diffuse, LEAST_DIFFUSE * self._mean)
        self._factorise()

    def _texel_means(self, weighted: Double) -> Double:
        """(num_texels, 3, K) generalised means from weighted values."""
        sums = self.sums_of_texels(weighted.reshape(len(weighted), -1))
        means: Double = self._texel_covariance @ sums.reshape(self._num_texels, *weighted.shape[1:])
        return means

    def _factorise(self) -> None:
        """Everything that follows from the variances."""
        seen = self._level + self._specular
        variance = (_INDEPENDENT * seen) ** 2 + (_OF_SPECULAR * self._specular) ** 2
        self._variance = (variance + self._noise**2) * self._scale / self._robust_weight[:, None]
        self._towards_level = self._level / self._variance
        self._own_precision = self._robust_weight / self._own_deviation**2 + (
            self._towards_level * self._level
        ).sum(axis=1)
        # Each sample's inverse 3 x 3 covariance, of its own errors.
        weight = -np.einsum("pi,pj->pij", self._towards_level, self._towards_level)
        weight /= self._own_precision[:, None, None]
        weight[:, range(3), range(3)] += 1 / self._variance
        self._weight = weight
        of_texels = self.sums_of_texels(weight.reshape(-1, 9)).reshape(-1, 3, 3)
        self._texel_covariance = np.linalg.inv(of_texels)
        self._shared = SharedErrors(
            self._effects, self._deviation, self._level, weight, self._texel, of_texels
        )


def _effects(samples: ViewSamples) -> list[tuple[Long, int | None]]:
    """The shared errors: which of them each sample has (-1: none), and the one channel that it is
    for (None: all three alike)."""
    frame, side = _shared(samples.frame), samples.cell
    extent = float(np.ptp(samples.position, axis=0).max())
    place = samples.position - samples.position.min(axis=0)
    while True:
        cells = [np.floor(place / size).astype(np.int64) for size in (side, 2.5 * side)]
        numbers = [(samples.frame << 40) + (cell << [26, 13, 0]).sum(axis=1) for cell in cells]
        small, large = map(_shared, numbers)
        every: list[tuple[Long, int | None]] = [(frame, None), (small, None), (large, None)]
        every += [(which, channel) for which in (frame, large) for channel in range(3)]
        # Their number bounds memory and time. Each of many frames has some, whatever the cells.
        number = sum(int(which.max(initial=-1)) + 1 for which, _ in every)
        if number <= _MOST_EFFECTS or side > extent:
            return every
        side *= 1.5


def _shared(group: Long) -> Long:
    """The groups counted from 0; -1 for those of a single sample, whose own error is enough."""
    number = np.unique(group, return_inverse=True)[1]
    alone = np.bincount(number)[number] < 2
    shared = np.full(len(group), -1, np.int64)
    shared[~alone] = np.unique(number[~alone], return_inverse=True)[1]
    return shared
