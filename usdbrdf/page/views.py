"""Views of the page: photographs beside both models' pictures with the errors between them, made
here, or taken from what ``evaluate`` has made already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.views import Views
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation import report as figures
from usdbrdf.evaluation.evaluate_views import (
    DOCUMENT,
    MODELS,
    ScoredView,
    ViewedAsset,
    exposure_of_views,
    scored_views,
)
from usdbrdf.files.documents import read_json
from usdbrdf.files.images import read_radiance, resized
from usdbrdf.files.paths import contained
from usdbrdf.model.arrays import Byte
from usdbrdf.options import EvaluateOptions
from usdbrdf.page.pictures import as_bytes, data_uri

# Views that are shown and views that are plotted, at most, and pixels across of either.
SHOWN, _PLOTTED = 8, 30
SHOWN_WIDTH, _PLOTTED_WIDTH = 480, 96
_PICTURE = EvaluateOptions(samples_per_pixel=1, rays=16)
_PHOTOGRAPH = "photograph"
# Figures that the page tells of a view.
_TOLD = ("flip_baseline", "flip_full", "l2_baseline", "l2_full")


@dataclass(frozen=True, kw_only=True)
class ShownView:
    """A row of figures, and pictures (H, W, 3) of one size: photograph, baseline, full,
    flip_baseline, flip_full."""

    row: figures.Row
    pictures: Mapping[str, Byte]

    def told(self, photographs: bool) -> dict[str, Any]:
        """As JSON, with or without what photographs show."""
        height, width = self.pictures["full"].shape[:2]
        shown = {k: v for k, v in self.pictures.items() if photographs or k != _PHOTOGRAPH}
        return {
            "row": unnamed(self.row, photographs),
            "size": [width, height],
            **{name: data_uri(picture) for name, picture in shown.items()},
        }


def unnamed(row: Mapping[str, Any], photographs: bool) -> dict[str, Any]:
    """Without the photograph's name where nothing of photographs may be told."""
    return {k: v for k, v in row.items() if photographs or k not in ("name", "view")}


def rendered_views(
    seen: ViewedAsset, views: Views, photographs: bool
) -> tuple[list[ShownView], list[figures.Row]]:
    """The views that are shown, and rows of those that are plotted, which are smaller. Without
    ``photographs`` nothing of them stands where the model has nothing to show."""
    count = len(views.names)
    shown, plotted = spread_evenly(count, SHOWN), spread_evenly(count, _PLOTTED)
    taken = [*shown, *plotted]
    asked = Views(names=tuple(views.names[i] for i in taken), frames=views.frames.at(taken))
    widths = [SHOWN_WIDTH] * len(shown) + [_PLOTTED_WIDTH] * len(plotted)
    exposure = exposure_of_views(views.frames.at(shown))
    scored = [
        replace(view, row={**view.row, "number": i})
        for view, i in zip(
            scored_views(seen, asked, exposure, _PICTURE, widths), taken, strict=True
        )
    ]
    pictures = [_shown(view, photographs) for view in scored[: len(shown)]]
    return pictures, [view.row for view in scored[len(shown) :]]


def _shown(view: ScoredView, photographs: bool) -> ShownView:
    own = view.counted[..., None] | photographs
    pictures = {_PHOTOGRAPH: as_bytes(view.reference)}
    for model in MODELS:
        pictures[model] = as_bytes(np.where(own, view.shown[model], 0))
        pictures[f"flip_{model}"] = figures.magma(view.errors[model], view.counted)
    return ShownView(row=view.row, pictures=pictures)


def evaluated_views(folder: Path, asset: Asset) -> tuple[list[ShownView], list[figures.Row]]:
    """The same of a folder that ``evaluate`` wrote. InputRefused where it is none, is of another
    asset or lighting, or lacks a picture."""
    document = read_json(folder / DOCUMENT)
    rows = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(rows, list) or not rows or not all(map(_is_row, rows)):
        raise InputRefused(
            f"{folder / DOCUMENT}: this is no document of usdbrdf evaluate. Name the folder that "
            "it wrote. [report.evaluation]"
        )
    if document.get("asset") != asset.name:
        raise InputRefused(
            f"{folder / DOCUMENT}: these are views of {document.get('asset')!r}, not of "
            f"{asset.name!r}. Run usdbrdf evaluate on this asset. [report.evaluation]"
        )
    if document.get("lighting", "") != asset.lighting:
        shown = document.get("lighting") or "one that it does not name"
        raise InputRefused(
            f"{folder / DOCUMENT}: these are views in the lighting {shown!r}, not in "
            f"{asset.lighting!r}. Run usdbrdf evaluate with --lighting {asset.lighting}. "
            "[report.evaluation]"
        )
    listed = [str(name) for name in document.get(figures.FILES, ())]
    listed = [name for name in listed if name.endswith(".png") and ".flip_" not in name]
    shown = []
    for i in spread_evenly(len(rows), SHOWN):
        start = f"pictures/{rows[i]['number']:04d}_"
        sheets = [
            n for n in listed if n.startswith(start) and n.endswith(".png") and ".flip_" not in n
        ]
        if not sheets:
            raise InputRefused(
                f"{folder}: the picture of the view {rows[i]['view']!r} is not there. Run usdbrdf "
                "evaluate again. [report.evaluation]"
            )
        shown.append(ShownView(row=rows[i], pictures=_cut(contained(folder, sheets[0]))))
    return shown, rows


def _is_row(row: object) -> bool:
    return (
        isinstance(row, dict)
        and isinstance(row.get("number"), int)
        and isinstance(row.get("view"), str)
        and all(isinstance(row.get(name), int | float | None) for name in _TOLD)
    )


def _cut(sheet: Path) -> dict[str, Byte]:
    """The pictures of a sheet, see ``evaluate``: three side by side, and again three."""
    whole = read_radiance(sheet)
    parts = figures.parts_of_sheet(whole, rows=2, columns=3)
    names = (_PHOTOGRAPH, *MODELS, "", *(f"flip_{model}" for model in MODELS))
    found = {}
    for name, part in zip(names, parts, strict=True):
        height, width = part.shape[:2]
        if name and width > SHOWN_WIDTH:
            part = resized(part, SHOWN_WIDTH, max(1, round(height * SHOWN_WIDTH / width)))
        if name:
            found[name] = as_bytes(np.nan_to_num(part))
    return found


def models_only(rows: Sequence[figures.Row]) -> list[dict[str, Any]]:
    """What is plotted of views."""
    return [{k: row.get(k) for k in ("number", *_TOLD)} for row in rows]
