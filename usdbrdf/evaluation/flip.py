"""FLIP (Andersson et al. 2020), the difference that a person sees when two pictures alternate.

The package ends the interpreter on some inputs, reads a fourth channel as colour and takes NaN for
a number: so it runs in a child process, which checks the pictures first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import UsdBrdfError
from usdbrdf.job.child import run_child

Float = npt.NDArray[np.float32]

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
        "usdbrdf.evaluation.flip:flip_in_child",
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
