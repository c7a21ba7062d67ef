"""What many views of the same texels say of a lobe, with the errors that photographs really have.

A sample of texel t in frame f, three channels at once, is

    I_tf = D_t + I_nd(t, f) + D_t * (u_f + u_fc + v_fp + w_fq + w_fqc + e_tf) + n_tf

D_t is the texel's own diffuse radiance and stays free. The errors in brackets are relative and
random. They are shared by all samples of a frame (exposure; u_fc for one channel alone: white
balance) or by the neighbours in patches p < q of a frame (the frame's own noise, smoothed by
whatever was done to it, and light that the model lacks), or by the three channels of one sample
(e). n is independent: noise floor, and errors in proportion to what is seen. A fit that takes all
samples for independent mistakes such shared errors for a lobe.

It is a linear mixed model. D_t and the shared errors are eliminated exactly: costs are the
generalised least squares' ones. The variances come from the samples themselves by a few steps of
expectation maximisation (Laird and Ware, "Random-Effects Models for Longitudinal Data", 1982), and
outliers lose weight as under Student's t distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg, sparse

Float = npt.NDArray[np.float32]
Double = npt.NDArray[np.float64]
Long = npt.NDArray[np.int64]

# Independent errors, relative to the radiance and to its specular part, before they are scaled.
_INDEPENDENT, _OF_SPECULAR = 0.012, 0.05
# Where the search for the shared errors' standard deviations starts, and their least value.
_FIRST_GUESS, _LEAST = 0.02, 1e-4
# With more shared errors than this, patches are made larger.
_MOST_EFFECTS = 2500
# Degrees of freedom of Student's t.
_TAIL = 15.0
# A texel's own diffuse radiance is taken to be at least this share of its mean radiance.
_LEAST_LEVEL = 0.1


@dataclass(frozen=True, kw_only=True)
class ViewSamples:
    """P samples: texel (P,) counted from 0 without gaps, frame (P,), position (P, 3) in metres,
    radiance (P, 3); noise (P, 3), standard deviation of independent errors, the least there is;
    patch: size of the smaller patches."""

    texel: Long
    frame: Long
    position: Float
    radiance: Float
    noise: Float
    patch: float


@dataclass(frozen=True, kw_only=True)
class Reduced:
    """(P, 3) values freed of the texels' means, the same weighted, and their part along the shared
    errors, whitened."""

    values: Double
    weighted: Double
    shared: Double


class ViewModel:
    """The model above at its present variances; ``update`` improves them."""

    def __init__(self, samples: ViewSamples) -> None:
        self._texel = samples.texel
        self._num_texels = int(samples.texel.max()) + 1
        self._radiance = samples.radiance.astype(np.float64)
        self._noise = samples.noise.astype(np.float64)
        count = np.bincount(samples.texel)
        mean = np.stack([np.bincount(samples.texel, c) / count for c in self._radiance.T], axis=-1)
        mean = np.maximum(mean, _LEAST_LEVEL * mean.mean(axis=1, keepdims=True))[samples.texel]
        self._mean, self._level = mean, mean
        self._specular = np.zeros_like(mean)
        # Of all samples, what is left for errors after each texel took its mean.
        self._freedom = len(samples.texel) / (len(samples.texel) - len(count))
        self._effects = _effects(samples)
        self._deviation = np.full(len(self._effects), _FIRST_GUESS)
        self._own_deviation = _FIRST_GUESS
        self._scale = 1.0
        self._trust = np.ones(len(samples.texel))
        self._factorise()

    @property
    def degrees_of_freedom(self) -> int:
        return 3 * (len(self._texel) - self._num_texels)

    def reduced(self, values: npt.NDArray[np.floating]) -> Reduced:
        """Prepare (P, 3) values for ``product``."""
        return self.all_reduced([values])[0]

    def all_reduced(self, many: Sequence[npt.NDArray[np.floating]]) -> list[Reduced]:
        """The same for many at once, which is faster."""
        means = [self._texel_means(self._weigh(values)) for values in many]
        rest = [values - mean[self._texel] for values, mean in zip(many, means, strict=True)]
        weighted = [self._weigh(values) for values in rest]
        along = self._design.T @ np.stack([values.reshape(-1) for values in weighted], axis=1)
        shared = linalg.solve_triangular(self._factor, along, trans="T", check_finite=False)
        return [
            Reduced(values=values, weighted=its, shared=own)
            for values, its, own in zip(rest, weighted, shared.T, strict=True)
        ]

    def product(self, a: Reduced, b: Reduced) -> float:
        """a' C^-1 b, C being the covariance of the samples with the diffuse parts left free."""
        return float((a.values * b.weighted).sum()) - float(a.shared @ b.shared)

    def update(self, non_diffuse: npt.NDArray[np.floating]) -> None:
        """One step of expectation maximisation, given I_nd (P, 3) of the best lobe so far."""
        rest = self._radiance - non_diffuse
        white = self.reduced(rest).shared
        effect = linalg.solve_triangular(self._factor, white, check_finite=False)
        square = effect**2 + _diagonal_of_inverse(self._factor)
        self._deviation = np.array(
            [
                max(_LEAST, float(np.sqrt(square[first:last].mean()))) if last > first else _LEAST
                for first, last in zip(self._first, self._first[1:], strict=False)
            ]
        )
        left = self.reduced(rest - (self._design @ effect).reshape(-1, 3))
        own_variance = 1 / self._own_precision
        own = (self._towards_level * left.values).sum(axis=1) * own_variance
        self._own_deviation = float(np.sqrt((self._trust * (own**2 + own_variance)).mean()))
        alone = left.values - own[:, None] * self._level
        explained = (self._level**2 * own_variance[:, None] / self._variance).mean()
        self._scale *= float((alone**2 / self._variance).mean() * self._freedom + explained)
        distance = (left.values * left.weighted).sum(axis=1) * self._freedom / self._trust
        self._trust = (_TAIL + 3) / (_TAIL + distance)
        self._specular = np.maximum(non_diffuse, 0).astype(np.float64)
        diffuse = self._texel_means(self._weigh(rest))[self._texel]
        self._level = np.maximum(diffuse, _LEAST_LEVEL * self._mean)
        self._factorise()

    def _weigh(self, values: npt.NDArray[np.floating]) -> Double:
        """Each sample's inverse 3 x 3 covariance, of its own errors, times its values."""
        along = (self._towards_level * values).sum(axis=1) / self._own_precision
        weighted: Double = values / self._variance - self._towards_level * along[:, None]
        return weighted

    def _texel_means(self, weighted: Double) -> Double:
        """(num_texels, 3) generalised means from weighted values."""
        sums = [np.bincount(self._texel, c, self._num_texels) for c in weighted.T]
        means: Double = np.einsum("tij,jt->ti", self._texel_covariance, np.stack(sums))
        return means

    def _factorise(self) -> None:
        """Everything that follows from the variances."""
        seen = self._level + self._specular
        variance = (_INDEPENDENT * seen) ** 2 + (_OF_SPECULAR * self._specular) ** 2
        self._variance = (variance + self._noise**2) * self._scale / self._trust[:, None]
        self._towards_level = self._level / self._variance
        self._own_precision = self._trust / self._own_deviation**2 + (
            self._towards_level * self._level
        ).sum(axis=1)
        weight = -np.einsum("pi,pj->pij", self._towards_level, self._towards_level)
        weight /= self._own_precision[:, None, None]
        weight[:, range(3), range(3)] += 1 / self._variance
        sums = [np.bincount(self._texel, w, self._num_texels) for w in weight.reshape(-1, 9).T]
        self._texel_covariance = np.linalg.inv(np.stack(sums, axis=-1).reshape(-1, 3, 3))
        self._design, self._first = _design(self._effects, self._level)
        self._factor = linalg.cholesky(self._normal_matrix(weight), check_finite=False)

    def _normal_matrix(self, weight: Double) -> Double:
        """The shared errors' normal equations, texel means eliminated, with their priors."""
        count, texels = len(self._texel), self._num_texels
        weighted = _block_diagonal(weight) @ self._design
        rows = (3 * self._texel[:, None] + np.arange(3)).reshape(-1)
        gather = sparse.csr_matrix(
            (np.ones(3 * count), (rows, np.arange(3 * count))), shape=(3 * texels, 3 * count)
        )
        of_texels = gather @ weighted
        means = of_texels.T @ (_block_diagonal(self._texel_covariance) @ of_texels)
        normal: Double = (self._design.T @ weighted - means).toarray()
        precision = np.repeat(1 / self._deviation**2, np.diff(self._first))
        normal[np.diag_indices_from(normal)] += precision
        return normal


def _effects(samples: ViewSamples) -> list[tuple[Long, int | None]]:
    """The shared errors: which of them each sample has (-1: none), and the one channel that it is
    for (None: all three alike)."""
    frame, patch = _shared(samples.frame), samples.patch
    while True:
        cells = [_cells(samples.position, size) for size in (patch, 2.5 * patch)]
        small, large = (_shared(samples.frame * (1 << 40) + cell) for cell in cells)
        every: list[tuple[Long, int | None]] = [(frame, None), (small, None), (large, None)]
        every += [(which, channel) for which in (frame, large) for channel in range(3)]
        # The normal matrix is dense: its size bounds memory and time.
        if sum(int(which.max(initial=-1)) + 1 for which, _ in every) <= _MOST_EFFECTS:
            return every
        patch *= 1.5


def _cells(position: Float, size: float) -> Long:
    """A number for the cube of that size in which each point lies."""
    cell = np.floor((position - position.min(axis=0)) / size).astype(np.int64)
    number: Long = (cell[:, 0] << 26) + (cell[:, 1] << 13) + cell[:, 2]
    return number


def _shared(group: Long) -> Long:
    """The groups counted from 0; -1 for those of a single sample, whose own error is enough."""
    number = np.unique(group, return_inverse=True)[1]
    alone = np.bincount(number)[number] < 2
    shared = np.full(len(group), -1, np.int64)
    shared[~alone] = np.unique(number[~alone], return_inverse=True)[1]
    return shared


def _design(
    effects: list[tuple[Long, int | None]], level: Double
) -> tuple[sparse.csr_matrix, Long]:
    """How the shared errors enter the 3 P channel values, and the first column of each kind."""
    first = np.cumsum([0] + [int(which.max(initial=-1)) + 1 for which, _ in effects])
    rows, columns, values = [], [], []
    for (which, channel), start in zip(effects, first, strict=False):
        sample = np.flatnonzero(which >= 0)
        for c in range(3) if channel is None else (channel,):
            rows.append(3 * sample + c)
            columns.append(start + which[sample])
            values.append(level[sample, c])
    places = np.concatenate(rows), np.concatenate(columns)
    shape = 3 * len(level), int(first[-1])
    return sparse.csr_matrix((np.concatenate(values), places), shape=shape), first


def _diagonal_of_inverse(factor: Double) -> Double:
    """From an upper Cholesky factor; LAPACK itself refuses a matrix without rows."""
    if not len(factor):
        return np.zeros(0)
    diagonal: Double = np.diag(linalg.lapack.dpotri(factor)[0])
    return diagonal


def _block_diagonal(blocks: Double) -> sparse.bsr_matrix:
    count = len(blocks)
    return sparse.bsr_matrix(
        (blocks, np.arange(count), np.arange(count + 1)), shape=(3 * count, 3 * count)
    )
