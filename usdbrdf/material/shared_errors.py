"""Errors that samples of a frame share, eliminated frame by frame.

With the texels' own diffuse radiance left free, the shared errors z have the normal matrix

    A = E - B T^-1 B',    A^-1 = E^-1 + E^-1 B S^-1 B' E^-1,    S = T - B' E^-1 B

(Woodbury). E = Z' W Z + 1 / variance of z falls into one small block per frame, T = X' W X into one
per texel, and only S, three rows per texel, is dense: A itself is far larger. W is the inverse
covariance of the samples' own errors, Z says what z adds to the samples, X which texel each shows;
B = Z' W X.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import linalg

from usdbrdf.kernel import loop

Double = npt.NDArray[np.float64]
Long = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class FrameEffects:
    """What the samples of one frame share: samples (M,), kind (n,) of each shared error, and which
    channels of the samples have it, (3 M, n)."""

    samples: Long
    kind: Long
    has: Bool


@dataclass(frozen=True, kw_only=True)
class Effects:
    """The shared errors of all frames, and how many kinds there are."""

    frames: list[FrameEffects]
    kinds: int


def effects_of_frames(every: Sequence[tuple[Long, int | None]], frame: Long) -> Effects:
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
        one = FrameEffects(
            samples=samples, kind=np.concatenate(kinds), has=np.concatenate(columns, axis=1)
        )
        if len(one.kind):
            frames.append(one)
    return Effects(frames=frames, kinds=len(every))


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
        effects: Effects,
        deviation: Double,
        level: Double,
        weight: Double,
        texel: Long,
        of_texels: Double,
    ) -> None:
        """deviation (kinds,); level (P, 3), what an error of 1 adds; weight (P, 3, 3), W; texel
        (P,); of_texels (texels, 3, 3), T."""
        self._kinds, self._count = effects.kinds, len(level)
        count = len(of_texels)
        blocks = np.zeros((count, 3, count, 3))
        blocks[np.arange(count), :, np.arange(count)] = of_texels
        dense = blocks.reshape(3 * count, 3 * count)
        self._frames = []
        for one in effects.frames:
            frame = _frame(one, deviation, level, weight, texel)
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


def _frame(
    effects: FrameEffects, deviation: Double, level: Double, weight: Double, texel: Long
) -> _Frame:
    samples = effects.samples
    adds = effects.has * level[samples].reshape(-1, 1)
    weighted = (weight[samples] @ adds.reshape(len(samples), 3, -1)).reshape(adds.shape)
    normal = adds.T @ weighted
    normal[np.diag_indices_from(normal)] += 1 / deviation[effects.kind] ** 2
    inverse_root, _ = linalg.lapack.dtrtri(np.linalg.cholesky(normal), lower=True)
    return _Frame(
        samples=samples,
        kind=effects.kind,
        places=(3 * texel[samples][:, None] + np.arange(3)).ravel(),
        inverse_root=inverse_root,
        along=inverse_root @ adds.T,
        of_texels=inverse_root @ weighted.T,
    )
