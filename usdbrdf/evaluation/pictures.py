"""Pictures for people: error maps in colour, and several pictures on one sheet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Float = npt.NDArray[np.float32]
Byte = npt.NDArray[np.uint8]
Bool = npt.NDArray[np.bool_]

# Matplotlib's magma (CC0) at nine equal steps, as FLIP shows its maps; linear in between.
_MAGMA = np.array(
    [(0, 0, 4), (28, 16, 68), (79, 18, 123), (129, 37, 129), (181, 54, 122), (229, 80, 100),
     (251, 135, 97), (254, 194, 135), (252, 253, 191)], np.float32,
)  # fmt: skip
_GREY = np.array((96, 96, 96), np.uint8)
# A change of this much in FLIP gets the full colour.
_FULL_CHANGE = 0.2
_GAP = 4  # pixels between the pictures of a sheet


def magma(error: Float, counted: Bool | None = None) -> Byte:
    """(H, W, 3) sRGB of errors (H, W), black at 0 and pale yellow from 1; grey: not counted."""
    steps = np.linspace(0, 1, len(_MAGMA))
    level = np.clip(np.nan_to_num(error), 0, 1)
    colour = np.stack([np.interp(level, steps, _MAGMA[:, c]) for c in range(3)], axis=-1)
    return _masked((colour + 0.5).astype(np.uint8), counted)


def change(before: Float, after: Float, counted: Bool | None = None) -> Byte:
    """(H, W, 3) sRGB of what became of an error (H, W): blue smaller, orange larger, black same."""
    amount = np.clip((after - before) / _FULL_CHANGE, -1, 1)[..., None]
    smaller, larger = np.array((70, 150, 255.0)), np.array((255, 140, 40.0))
    colour = np.maximum(-amount, 0) * smaller + np.maximum(amount, 0) * larger
    return _masked((colour + 0.5).astype(np.uint8), counted)


def sheet(rows: Sequence[Sequence[Byte]]) -> Byte:
    """Pictures of one size side by side, rows below each other, with white gaps."""
    height, width = rows[0][0].shape[:2]
    columns = max(len(row) for row in rows)
    shape = len(rows) * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3
    whole = np.full(shape, 255, np.uint8)
    for j, row in enumerate(rows):
        for i, picture in enumerate(row):
            top, left = j * (height + _GAP), i * (width + _GAP)
            whole[top : top + height, left : left + width] = picture
    return whole


def _masked(colour: Byte, counted: Bool | None) -> Byte:
    return colour if counted is None else np.where(counted[..., None], colour, _GREY)
