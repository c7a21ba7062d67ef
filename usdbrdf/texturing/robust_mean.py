"""Running means per texel that outliers do not spoil, with a state of fixed size.

A median takes all frames for equally good. Where their noise is known, weights make more of the
same frames: exposures differ by ten times in noise, and near views by as much in sharpness. So a
texel keeps Huber's M-estimate (P. Huber, "Robust Estimation of a Location Parameter", 1964): every
five samples are added to what came before by reweighted least squares, in which a sample that lies
further off than its own error allows loses weight. The first five start from their median.

Besides the mean are kept its variance, and what a pixel covered of the surface, on the average of
the samples weighted by their precision: how blurred it is.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from usdbrdf import calibration
from usdbrdf.kernel import kernel, parallel_kernel
from usdbrdf.model.arrays import Float, Int
from usdbrdf.texturing.passes import by_parts

# Samples that are added at a time.
_BATCH = 5
# Deviations from which a sample loses weight, and steps of the reweighting.
_OUTLYING = calibration.number("robust_mean.outlying")
_STEPS = 6
_LEFT = calibration.number("robust_mean.left")
# Texels whose mean is worked out at a time.
_AT_A_TIME = 1 << 18


class MeanState(NamedTuple):
    """What is kept of all samples so far: 144 bytes per texel, however many frames there were.

    waiting    (T, 5, 4) float32, radiance and standard deviation of samples not yet added
    samples    (T,) int32, samples so far
    mean       (T, 3) float32; weight (T, 3) float32, sums of the samples' robust weights
    scatter    (T, 2) float32, over the channels: squares of what each sample pulls at the mean, and
               weights of those that lie within their errors
    precision  (T,) float32, sum of 1 / variance of the samples
    footprint  (T, 3) float32, sum of the samples' footprints by 1 / variance
    uneven     (T, 3) float32, sum of what the samples were divided by, by 1 / variance
    """

    waiting: Float
    samples: Int
    mean: Float
    weight: Float
    scatter: Float
    precision: Float
    footprint: Float
    uneven: Float

    @classmethod
    def empty(cls, num_texels: int) -> MeanState:
        def zeros(*shape: int) -> Float:
            return np.zeros((num_texels, *shape), np.float32)

        return cls(
            waiting=zeros(_BATCH, 4),
            samples=np.zeros(num_texels, np.int32),
            mean=zeros(3),
            weight=zeros(3),
            scatter=zeros(2),
            precision=zeros(),
            footprint=zeros(3),
            uneven=zeros(3),
        )


class RobustMean(NamedTuple):
    """mean (T, 3), NaN where a texel has no sample; variance (T,), the mean over the channels, of a
    single sample what was said of it; footprint (T, 3): covariance xx, xy, yy; uneven (T, 3): what
    the samples were divided by."""

    mean: Float
    variance: Float
    footprint: Float
    uneven: Float


def update(
    state: MeanState, texel: Int, values: Float, deviation: Float, footprint: Float, uneven: Float
) -> None:
    """Add one sample to each of the listed texels, in place.

    texel      (M,) int32, each texel at most once
    values     (M, 3) float32, finite
    deviation  (M,) float32, standard deviation of their errors, between 1e-15 and 1e15
    footprint  (M, 3) float32, covariance xx, xy, yy of a pixel on the surface
    uneven     (M, 3) float32, what the values were divided by
    """
    _update(len(texel), *state, texel, values, deviation, footprint, uneven)


@parallel_kernel
def _update(
    first: int, last: int, waiting: Float, samples: Int, mean: Float, weight: Float,
    scatter: Float, precision: Float, covered: Float, divided: Float, texel: Int, values: Float,
    deviation: Float, footprint: Float, uneven: Float,
) -> None:  # fmt: skip
    for m in range(first, last):
        t = texel[m]
        slot = samples[t] % _BATCH
        for c in range(3):
            waiting[t, slot, c] = values[m, c]
        waiting[t, slot, 3] = deviation[m]
        samples[t] += 1
        own = 1 / float(deviation[m]) ** 2
        precision[t] += own
        for k in range(3):
            covered[t, k] += own * footprint[m, k]
            divided[t, k] += own * uneven[m, k]
        if slot == _BATCH - 1:
            _add(waiting[t], mean[t], weight[t], scatter[t])


def robust_mean(state: MeanState) -> RobustMean:
    """Of all samples so far; ``state`` stays as it is."""
    count = len(state.samples)
    parts = [slice(start, start + _AT_A_TIME) for start in range(0, max(count, 1), _AT_A_TIME)]

    def means(part: slice) -> dict[str, Float]:
        some = MeanState._make(values[part] for values in state)
        mean, weight, scatter = some.mean.copy(), some.weight.copy(), some.scatter.copy()
        _add_rest(len(some.samples), some.waiting, some.samples, mean, weight, scatter)
        # Variance of an M-estimate, sum psi^2 / (sum psi')^2; at least one lies within its error.
        pull, inlying = scatter.T.astype(np.float64) / 3
        count = np.maximum(some.samples, 1)
        variance = pull / np.maximum(np.maximum(inlying, some.precision / count), 1e-30) ** 2
        return {
            "mean": np.where(some.samples[:, None] > 0, mean, np.nan),
            "variance": variance.astype(np.float32),
            "footprint": some.footprint / np.maximum(some.precision, 1e-30)[:, None],
            "uneven": some.uneven / np.maximum(some.precision, 1e-30)[:, None],
        }

    return RobustMean(**by_parts(parts, means))


@parallel_kernel
def _add_rest(
    first: int, last: int, waiting: Float, samples: Int, mean: Float, weight: Float, scatter: Float
) -> None:
    for t in range(first, last):
        rest = samples[t] % _BATCH
        if rest:
            _add(waiting[t, :rest], mean[t], weight[t], scatter[t])


@kernel
def _add(samples: Float, mean: Float, weight: Float, scatter: Float) -> None:
    """Add ``samples`` (N, 4) to one texel's mean, weight (3,) and scatter (2,), in place."""
    for c in range(3):
        before, known = float(mean[c]), float(weight[c])
        centre = before if known > 0 else float(np.median(samples[:, c]))
        for _ in range(_STEPS):
            total, sum_of_weights = known * before, known
            for j in range(len(samples)):
                own = huber_weight(samples[j], c, centre) / float(samples[j, 3]) ** 2
                total += own * samples[j, c]
                sum_of_weights += own
            centre = total / sum_of_weights
        mean[c], weight[c] = centre, sum_of_weights
        for j in range(len(samples)):
            share, own = huber_weight(samples[j], c, centre), 1 / float(samples[j, 3]) ** 2
            # The mean follows each of its samples; what is left of one tells of its error, unless
            # there is hardly any other.
            left = 1 - share * own / sum_of_weights
            if left > _LEFT:
                scatter[0] += (share * own * (samples[j, c] - centre)) ** 2 / left
            else:
                scatter[0] += own
            if share == 1:
                scatter[1] += own


@kernel
def huber_weight(sample: Float, c: int, centre: float) -> float:
    """Huber's weight of channel c, 1 within its error."""
    off = abs(float(sample[c]) - centre) / float(sample[3])
    return min(1.0, _OUTLYING / max(off, 1e-12))
