"""What is measured between a picture or a map and its reference."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import UsdBrdfError
from usdbrdf.job.child import run_child
from usdbrdf.model.arrays import Bool, Float


def relative_l2(image: Float, reference: Float, counted: Bool) -> float:
    """||image - reference|| / ||reference|| over the pixels ``counted``; NaN without light there.

    image, reference (H, W, 3) linear radiance; counted (H, W). Values elsewhere may be NaN.
    """
    x, ref = image[counted].astype(np.float64), reference[counted].astype(np.float64)
    norm = float(np.linalg.norm(ref))
    return float(np.linalg.norm(x - ref)) / norm if norm > 0 else math.nan


def psnr(image: Float, reference: Float, counted: Bool) -> float:
    """Peak signal to noise ratio in dB, -10 log10(mean squared error), of display values in [0, 1]
    over the pixels ``counted``; infinite for equal pictures, NaN where nothing is counted."""
    if not counted.any():
        return math.nan
    error = float(np.mean((image[counted].astype(np.float64) - reference[counted]) ** 2))
    return -10 * math.log10(error) if error > 0 else math.inf


def nrmse(values: Float, reference: Float, area: Float) -> float:
    """||values - reference|| / ||reference|| of maps (T, C), weighted by texel area (T,): root mean
    square error over root mean square. NaN where the reference is 0 everywhere or empty."""
    weight = area.astype(np.float64)[:, None]
    norm = float((weight * reference.astype(np.float64) ** 2).sum())
    error = float((weight * (values.astype(np.float64) - reference) ** 2).sum())
    return math.sqrt(error / norm) if norm > 0 else math.nan


def median_relative(values: Float, reference: Float) -> tuple[float, float]:
    """Median of |values / reference - 1| and of values / reference - 1; NaN where empty."""
    if not values.size:
        return math.nan, math.nan
    relative = values / np.maximum(reference, 1e-6) - 1
    return float(np.median(np.abs(relative))), float(np.median(relative))


class MapError(NamedTuple):
    """How far a map is from its reference over the texels compared; None where there are none."""

    nrmse: float | None
    median_abs_relative: float | None
    median_signed: float | None


def map_error(values: Float, reference: Float, area: Float, scored: Bool) -> MapError:
    """NRMSE, weighted by ``area`` (T,), and median relative errors of maps (T, C) over ``scored``
    (T,)."""
    absolute, signed = median_relative(values[scored], reference[scored])
    whole = nrmse(values[scored], reference[scored], area[scored])
    return MapError(finite(whole), finite(absolute), finite(signed))


def finite(value: float, digits: int | None = None) -> float | None:
    """A number for a JSON document, which has no NaN and no infinity: None for those."""
    if not math.isfinite(value):
        return None
    return float(value) if digits is None else round(float(value), digits)


# Seen at 67 pixels per degree: a 4K screen 0.7 m wide from 0.7 m, the authors' default.
_SECONDS, _SECONDS_PER_MEGAPIXEL = 120.0, 60.0


class Pair(NamedTuple):
    """Two pictures (H, W, 3) of display values (sRGB) in [0, 1]."""

    reference: Float
    test: Float


def flip_maps(pairs: Sequence[Pair], label: str) -> list[Float]:
    """FLIP error maps (H, W) in [0, 1] of pairs of any sizes, by one child process.

    Raises UsdBrdfError for pictures that are not equal in size, have not three channels or leave
    [0, 1]; label: what they are, for messages.
    """
    if not pairs:
        return []
    arrays = {
        f"{name}-{i}": np.ascontiguousarray(picture, np.float32)
        for i, pair in enumerate(pairs)
        for name, picture in pair._asdict().items()
    }
    megapixels = sum(pair.reference.size for pair in pairs) / 3e6
    found = run_child(
        "usdbrdf.evaluation.metrics:flip_in_child",
        arrays,
        {"count": len(pairs)},
        _SECONDS + _SECONDS_PER_MEGAPIXEL * megapixels,
        f"FLIP of {label}",
    )
    return [found[f"map-{i}"] for i in range(len(pairs))]


def flip_in_child(
    arrays: Mapping[str, npt.NDArray[Any]], parameters: Mapping[str, Any]
) -> dict[str, npt.NDArray[Any]]:
    """The child's side of ``flip_maps``."""
    import flip_evaluator

    result = {}
    for i in range(parameters["count"]):
        reference, test = arrays[f"reference-{i}"], arrays[f"test-{i}"]
        _check(i, reference, test)
        error, _, _ = flip_evaluator.evaluate(
            reference, test, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=False
        )
        result[f"map-{i}"] = np.asarray(error, np.float32).reshape(reference.shape[:2])
    return result


def _check(number: int, reference: Float, test: Float) -> None:
    if reference.ndim != 3 or reference.shape[2] != 3 or not reference.size:
        problem = f"a reference of shape {reference.shape}, not (H, W, 3)"
    elif test.shape != reference.shape:
        problem = f"pictures of shapes {reference.shape} and {test.shape}"
    elif not (np.isfinite(reference).all() and np.isfinite(test).all()):
        problem = "values that are not finite"
    elif min(reference.min(), test.min()) < 0 or max(reference.max(), test.max()) > 1:
        problem = "values outside [0, 1]"
    else:
        return
    raise UsdBrdfError(f"FLIP was given {problem} (pair {number}). [evaluate.flip]")
