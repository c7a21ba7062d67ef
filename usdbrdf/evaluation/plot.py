"""The errors over the views, as in the paper's Fig. 8: diffuse baseline and full model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from usdbrdf.files.atomic import publish, temporary_beside
from usdbrdf.job.progress import say

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
