"""Views of an asset predicted, by the diffuse baseline and by the full model, and compared with
photographs: a row of figures and a sheet of pictures per view, and what is said of all of them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from usdbrdf.asset.readers.views import Views, photographs_of_views
from usdbrdf.evaluation.metrics import Pair, finite, flip_maps, psnr, relative_l2
from usdbrdf.evaluation.report import (
    FILES,
    Row,
    change,
    files_of,
    magma,
    output_folder,
    sheet,
    summary_of_views,
    table_text,
    write_plot,
)
from usdbrdf.evaluation.truth import compare_with_truth
from usdbrdf.evaluation.viewed_asset import (
    PredictedView,
    Quality,
    ViewedAsset,
    map_or,
    measured_atlas,
    predict_view,
    viewed_asset,
)
from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.files.colour import display_exposure, to_display_srgb
from usdbrdf.files.documents import write_json
from usdbrdf.files.frames import FramePixels, read_frame
from usdbrdf.files.images import write_preview_png
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool, Byte, Float
from usdbrdf.model.capture import Frames
from usdbrdf.options import EvaluateOptions

DOCUMENT = "evaluation.json"
MODELS = ("baseline", "full")
# Cameras and renderers smear a lamp over this many pixels around it.
_LAMP_MARGIN = 2
# Pixels of all photographs together that the exposure is taken from, at most.
_EXPOSURE_PIXELS = 1 << 24
# Pixels of views that wait for FLIP together, at most: what bounds the memory.
_WAITING_PIXELS = 1 << 23


def evaluate(
    asset: str | Path, views: str | Path, output: str | Path, options: EvaluateOptions | None = None
) -> dict[str, Any]:
    """Predict the views of a document from an asset, write figures and pictures to ``output``.

    asset    asset folder; only read
    views    nerfstudio document (transforms.json, views.json) of views of the asset's capture
    output   folder for evaluation.json, evaluation.csv, evaluation.png and pictures/
    returns  the content of evaluation.json

    Raises UsdBrdfError; ``output`` is then as it was.
    """
    chosen = options or EvaluateOptions()
    place, atlas = measured_atlas(Path(asset))
    with output_folder(Path(output), DOCUMENT, (place,)) as work:
        known = {}
        if chosen.truth is not None:
            albedo = map_or(atlas, "base_color", "albedo")
            known = {"truth": compare_with_truth(atlas, chosen.truth, chosen.mesh, albedo)}
        photographs = photographs_of_views(
            Path(views), place, atlas.stage, atlas.scene, chosen.allow_outside
        )
        exposure = exposure_of_views(photographs.frames)
        quality = Quality(per_side=chosen.per_side, rays=chosen.rays, seed=chosen.seed)
        seen = viewed_asset(place, atlas, chosen.environment)
        rows = score_views(work / "pictures", seen, photographs, exposure, quality)
        write_text_atomic(work / "evaluation.csv", table_text(rows))
        write_plot(work / "evaluation.png", rows)
        found = {
            "asset": place.name,
            "views": Path(views).name,
            "samples_per_pixel": chosen.samples_per_pixel,
            "rays": chosen.rays,
            "seed": chosen.seed,
            "exposure": exposure,
            "diffuse_map": map_or(atlas, "diffuse", "lit"),
            "summary": summary_of_views(rows),
            "frames": rows,
            **known,
            FILES: [*files_of(work), DOCUMENT],
        }
        write_json(work / DOCUMENT, found)
    return found


def exposure_of_views(frames: Frames) -> float:
    """One exposure for all views: 90 % of their known pixels come out below 0.8, linear."""
    stride = -(-int(frames.resolution.astype(np.int64).prod(axis=1).sum()) // _EXPOSURE_PIXELS)
    levels = []
    for i in range(len(frames)):
        level = read_frame(frames, i).radiance.mean(axis=2).ravel()[::stride]
        levels.append(level[np.isfinite(level)])
    return display_exposure(np.concatenate(levels))


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
    rows: list[Row] = []
    for batch in _batches(seen, views, exposure, quality):
        pairs = [Pair(v.reference, v.shown[model]) for v in batch for model in MODELS]
        maps = iter(flip_maps(pairs, f"{len(batch)} views"))
        for view in batch:
            errors = {model: next(maps) for model in MODELS}
            flips = {f"flip_{model}": _mean(errors[model][view.counted]) for model in MODELS}
            rows.append({**view.row, **flips})
            _write_pictures(folder, view, errors)
    return rows


@dataclass(frozen=True, kw_only=True)
class _Scored:
    """A view that waits for FLIP: its row without it, display pictures in [0, 1], the pixels that
    count."""

    row: Row
    reference: Float
    shown: dict[str, Float]
    counted: Bool


def _batches(
    seen: ViewedAsset, views: Views, exposure: float, quality: Quality
) -> Iterator[list[_Scored]]:
    waiting: list[_Scored] = []
    frames = views.frames
    for i in progress(range(len(frames)), total=len(frames), label="evaluate", unit="views"):
        seeded = quality._replace(seed=quality.seed + (i << 16))
        predicted = predict_view(seen, frames.camera(i), seeded)
        waiting.append(_scored(i, views.names[i], predicted, read_frame(frames, i), exposure))
        if sum(scored.counted.size for scored in waiting) >= _WAITING_PIXELS:
            yield waiting
            waiting = []
    if waiting:
        yield waiting


def _scored(
    number: int, name: str, predicted: PredictedView, photograph: FramePixels, exposure: float
) -> _Scored:
    counted = photograph.valid & predicted.surface
    measured = photograph.radiance
    reference = to_display_srgb(np.nan_to_num(measured), exposure_scale=exposure)
    dim = counted & ~ndimage.binary_dilation(predicted.lamp, np.ones((3, 3)), _LAMP_MARGIN)
    shown = {}
    row: dict[str, Any] = {"number": number, "view": name}
    for model, image in zip(MODELS, (predicted.baseline, predicted.full), strict=True):
        display = to_display_srgb(image, exposure_scale=exposure)
        cut, cut_measured = (np.minimum(x * exposure, 1) for x in (image, measured))
        row[f"l2_{model}"] = finite(relative_l2(image, measured, dim))
        row[f"l2_with_lamps_{model}"] = finite(relative_l2(image, measured, counted))
        row[f"l2_shown_{model}"] = finite(relative_l2(cut, cut_measured, dim))
        row[f"psnr_{model}"] = finite(psnr(display, reference, counted))
        shown[model] = np.where(counted[..., None], display, reference)
    row["compared"] = finite(counted.mean())
    row["lamps"] = finite(predicted.lamp.mean())
    return _Scored(row=row, reference=reference, shown=shown, counted=counted)


def _write_pictures(folder: Path, view: _Scored, errors: dict[str, Float]) -> None:
    """NAME.png: photograph, baseline, full above what changed and their FLIP maps; and the maps."""
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", Path(view.row["view"]).stem)[:80]
    name = f"{view.row['number']:04d}_{stem}"
    maps = {model: magma(errors[model], view.counted) for model in MODELS}
    for model, picture in maps.items():
        write_preview_png(folder / f"{name}.flip_{model}.png", picture)
    above = [_bytes(view.reference), *(_bytes(view.shown[model]) for model in MODELS)]
    changed = change(errors["baseline"], errors["full"], view.counted)
    write_preview_png(folder / f"{name}.png", sheet([above, [changed, *maps.values()]]))


def _bytes(display: Float) -> Byte:
    return (display * 255 + 0.5).astype(np.uint8)


def _mean(values: Float) -> float | None:
    return finite(values.mean(dtype=np.float64)) if values.size else None
