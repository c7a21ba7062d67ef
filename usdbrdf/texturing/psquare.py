"""Running quantiles per texel and channel with a state of fixed size.

R. Jain and I. Chlamtac, "The P-square algorithm for dynamic calculation of quantiles and
histograms without storing observations", Communications of the ACM 28(10), 1985. Five markers per
channel: minimum, p/2, p, (1+p)/2, maximum; so the median's state also yields the quartiles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Float, Int


class QuantileState(NamedTuple):
    """What is kept of all samples so far: 112 bytes per texel, however many frames there were.

    heights    (T, 3, 5) float32, the markers' values, ascending
    positions  (T, 3, 3) int32, ranks (from 1) of the three inner markers; the outer two are at
               1 and ``samples``
    samples    (T,) int32, samples so far
    mean       (T, 3) float32, running mean
    """

    heights: Float
    positions: Int
    samples: Int
    mean: Float

    @classmethod
    def empty(cls, num_texels: int) -> QuantileState:
        return cls(
            heights=np.zeros((num_texels, 3, 5), np.float32),
            positions=np.zeros((num_texels, 3, 3), np.int32),
            samples=np.zeros(num_texels, np.int32),
            mean=np.zeros((num_texels, 3), np.float32),
        )


def quantile(state: QuantileState, p: float) -> Float:
    """The running quantile, (T, 3) float32; NaN where a texel has no sample.

    Up to five samples it is the exact one (linear between ranks).
    """
    return _read(state, p, 2)


def spread(state: QuantileState, p: float) -> Float:
    """Distance of the (1+p)/2 and the p/2 quantile, (T, 3) float32: for the median the
    interquartile range. NaN where a texel has no sample."""
    return _read(state, (1 + p) / 2, 3) - _read(state, p / 2, 1)


def update(state: QuantileState, texel: Int, values: Float, p: float) -> None:
    """Add one sample to each of the listed texels, in place.

    texel   (M,) int32, each texel at most once
    values  (M, 3) float32, finite
    p       the quantile, in (0, 1)
    """
    _update(len(texel), *state, texel, values, p)


def clear(state: QuantileState, texel: Int) -> None:
    """Forget all samples of the listed texels, in place."""
    state.samples[texel] = 0
    state.mean[texel] = 0


@parallel_kernel
def _update(
    first: int, last: int, heights: Float, positions: Int, count: Int, mean: Float, texel: Int,
    values: Float, p: float,
) -> None:  # fmt: skip
    fractions = np.array([p / 2, p, (1 + p) / 2])
    for m in range(first, last):
        t = texel[m]
        n = count[t]
        for c in range(3):
            x = values[m, c]
            q = heights[t, c]
            mean[t, c] += (x - mean[t, c]) / (n + 1)
            if n < 5:
                k = n
                while k > 0 and q[k - 1] > x:
                    q[k] = q[k - 1]
                    k -= 1
                q[k] = x
                for i in range(3):
                    positions[t, c, i] = i + 2
            else:
                _add(q, positions[t, c], n, x, fractions)
        count[t] = n + 1


@kernel
def _add(q: Float, inner: Int, n: int, x: float, fractions: npt.NDArray[np.float64]) -> None:
    """One further sample for one channel that had n >= 5 (the paper's box, steps B1 to B3)."""
    if x < q[0]:
        q[0] = x
    elif x > q[4]:
        q[4] = x
    for i in range(3):
        if x < q[i + 1]:
            inner[i] += 1
    for i in range(3):
        desired = 1 + n * fractions[i]
        below = 1 if i == 0 else inner[i - 1]
        above = n + 1 if i == 2 else inner[i + 1]
        offset = desired - inner[i]
        if offset >= 1 and above - inner[i] > 1:
            step = 1
        elif offset <= -1 and below - inner[i] < -1:
            step = -1
        else:
            continue
        here = inner[i]
        parabola = q[i + 1] + step / (above - below) * (
            (here - below + step) * (q[i + 2] - q[i + 1]) / (above - here)
            + (above - here - step) * (q[i + 1] - q[i]) / (here - below)
        )
        if q[i] < parabola < q[i + 2]:
            q[i + 1] = parabola
        elif step > 0:
            q[i + 1] += (q[i + 2] - q[i + 1]) / (above - here)
        else:
            q[i + 1] -= (q[i] - q[i + 1]) / (below - here)
        inner[i] = here + step


@kernel
def _read(state: QuantileState, p: float, marker: int) -> Float:
    count = state.samples
    out = np.full((len(count), 3), np.nan, np.float32)
    for t in range(len(count)):
        n = count[t]
        for c in range(3):
            if n > 5:
                out[t, c] = state.heights[t, c, marker]
            elif n > 0:
                rank = p * (n - 1)
                low = int(rank)
                high = min(low + 1, n - 1)
                q = state.heights[t, c]
                out[t, c] = q[low] + (rank - low) * (q[high] - q[low])
    return out
