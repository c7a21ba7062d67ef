"""Pictures for people: error maps in colour, several pictures on one sheet, and the errors over the
views as in the paper's Fig. 8."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from usdbrdf.files.atomic import publish, temporary_beside
from usdbrdf.job.progress import say
from usdbrdf.model.arrays import Bool, Byte, Float

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


_LINES = (("baseline", "diffuse baseline", "tab:blue"), ("full", "full model", "tab:orange"))

_PANELS = (
    ("l2", "relative $L_2$ without lamps"),
    ("l2_shown", "the same, cut off at display white"),
    ("flip", "mean FLIP"),
)

_MARKED = 60  # so many views still get a dot each


def write_plot(path: Path, rows: Sequence[dict[str, float | str]]) -> bool:
    """Panels of L2 and FLIP over the rows ``l2_baseline``, ``l2_full``, ... as PNG.

    Without matplotlib nothing is drawn: one line says so, and False is returned.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        say(f"{path.name}: not drawn, matplotlib is missing. Install usdbrdf[report].")
        return False
    figure = Figure(figsize=(15, 4), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (metric, title) in zip(figure.subplots(1, len(_PANELS)), _PANELS, strict=True):
        for key, label, colour in _LINES:
            values = np.array([row[f"{metric}_{key}"] for row in rows], float)
            mark = "o" if len(rows) <= _MARKED else None
            axes.plot(values, label=label, color=colour, marker=mark, markersize=3, linewidth=1.2)
            if np.isfinite(values).any():
                axes.axhline(np.nanmean(values), color=colour, linestyle=":", linewidth=1)
        axes.set(xlabel="view", title=title)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    axes.legend()
    with temporary_beside(path) as staged:
        figure.savefig(staged, dpi=110, metadata={"Software": None})
        publish(staged, path)
    return True
