"""Every view rendered and compared with its photograph: one row of figures, one sheet."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from usdbrdf.evaluation.metrics import Pair, exposure_of, finite, flip_maps, psnr, relative_l2
from usdbrdf.evaluation.pictures import change, magma, sheet
from usdbrdf.evaluation.render_view import RenderedView, ViewedAsset, render_view
from usdbrdf.evaluation.views_from_file import Views
from usdbrdf.files.colour import to_display_srgb
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import write_preview_png
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool, Byte, Float
from usdbrdf.model.capture import Frames

Row = dict[str, Any]

MODELS = ("baseline", "full")

# Cameras and renderers smear a lamp over this many pixels around it.
_LAMP_MARGIN = 2

# Pixels of all photographs together that the exposure is taken from, at most.
_EXPOSURE_PIXELS = 1 << 24

# Pixels of views that wait for FLIP together, at most: what bounds the memory.
_WAITING_PIXELS = 1 << 23


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How carefully views are rendered: points per side of a pixel, rays per pixel, seed."""

    per_side: int
    rays: int
    seed: int


@dataclass(frozen=True, kw_only=True)
class _Scored:
    """A view that waits for FLIP: its row, display pictures in [0, 1], the pixels that count."""

    row: Row
    reference: Float
    shown: dict[str, Float]
    counted: Bool


def exposure_of_views(frames: Frames) -> float:
    """One exposure for all views: 90 % of their known pixels come out below 0.8, linear."""
    stride = -(-int(frames.resolution.astype(np.int64).prod(axis=1).sum()) // _EXPOSURE_PIXELS)
    levels = []
    for i in range(len(frames)):
        level = read_frame(frames, i).radiance.mean(axis=2).ravel()[::stride]
        levels.append(level[np.isfinite(level)])
    return exposure_of(np.concatenate(levels))


def score_views(
    folder: Path, seen: ViewedAsset, views: Views, exposure: float, quality: Quality
) -> list[Row]:
    """A row per view; a sheet per view and FLIP maps per model are written to ``folder``.

    Rows hold, per model, relative L2 without lamps, with them, and without them after radiance
    that is shown white is cut off; PSNR and mean FLIP of the display pictures; and the shares of
    pixels that are compared and that show a lamp. A pixel counts if the photograph knows it in
    every channel and all of it shows the asset; what does not count is made equal to the
    photograph before FLIP. Infinite PSNR (equal pictures) is None.
    """
    folder.mkdir()
    rows = []
    for batch in _batches(seen, views, exposure, quality):
        pairs = [Pair(v.reference, v.shown[model]) for v in batch for model in MODELS]
        maps = iter(flip_maps(pairs, f"{len(batch)} views"))
        for view in batch:
            errors = {model: next(maps) for model in MODELS}
            for model, error in errors.items():
                view.row[f"flip_{model}"] = finite(_mean(error[view.counted]))
            _write_pictures(folder, view, errors)
            rows.append(view.row)
    return rows


def _batches(
    seen: ViewedAsset, views: Views, exposure: float, quality: Quality
) -> Iterator[list[_Scored]]:
    waiting: list[_Scored] = []
    numbers = range(len(views.frames))
    for i in progress(numbers, total=len(numbers), label="evaluate", unit="views"):
        waiting.append(_score(seen, views, i, exposure, quality))
        if sum(view.counted.size for view in waiting) >= _WAITING_PIXELS:
            yield waiting
            waiting = []
    if waiting:
        yield waiting


def _score(seen: ViewedAsset, views: Views, i: int, exposure: float, quality: Quality) -> _Scored:
    frames = views.frames
    pixels = read_frame(frames, i)
    rendered = render_view(
        seen, frames.camera(i),
        per_side=quality.per_side, rays=quality.rays, seed=quality.seed + (i << 16),
    )  # fmt: skip
    counted = pixels.valid & rendered.surface
    reference = to_display_srgb(np.nan_to_num(pixels.radiance), exposure_scale=exposure)
    dim = counted & ~ndimage.binary_dilation(rendered.lamp, np.ones((3, 3)), _LAMP_MARGIN)
    shown = {}
    row: Row = {"number": i, "view": views.names[i]}
    for model in MODELS:
        image = _model(rendered, model)
        display = to_display_srgb(image, exposure_scale=exposure)
        row[f"l2_{model}"] = finite(relative_l2(image, pixels.radiance, dim))
        row[f"l2_with_lamps_{model}"] = finite(relative_l2(image, pixels.radiance, counted))
        row[f"l2_shown_{model}"] = finite(
            relative_l2(_cut(image, exposure), _cut(pixels.radiance, exposure), dim)
        )
        row[f"psnr_{model}"] = finite(psnr(display, reference, counted))
        shown[model] = np.where(counted[..., None], display, reference)
    row["compared"] = finite(counted.mean())
    row["lamps"] = finite(rendered.lamp.mean())
    return _Scored(row=row, reference=reference, shown=shown, counted=counted)


def _cut(radiance: Float, exposure: float) -> Float:
    return np.asarray(np.minimum(radiance * exposure, 1), np.float32)


def _model(rendered: RenderedView, model: str) -> Float:
    return rendered.full if model == "full" else rendered.baseline


def _write_pictures(folder: Path, view: _Scored, errors: dict[str, Float]) -> None:
    """NAME.png: photograph, baseline, full above what changed and their FLIP maps; and the maps."""
    name = f"{view.row['number']:04d}_{_safe(Path(view.row['view']).stem)}"
    maps = {model: magma(errors[model], view.counted) for model in MODELS}
    for model, picture in maps.items():
        write_preview_png(folder / f"{name}.flip_{model}.png", picture)
    above = [_bytes(view.reference), *(_bytes(view.shown[model]) for model in MODELS)]
    changed = change(errors["baseline"], errors["full"], view.counted)
    below = [changed, *maps.values()]
    write_preview_png(folder / f"{name}.png", sheet([above, below]))


def _bytes(display: Float) -> Byte:
    return (display * 255 + 0.5).astype(np.uint8)


def _mean(values: Float) -> float:
    return float(values.mean(dtype=np.float64)) if values.size else np.nan


def _safe(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", name)[:80]
