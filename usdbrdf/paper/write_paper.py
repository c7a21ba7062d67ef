"""Two assets of one scene in different light -> a folder with the tables and figures that the paper
shows of its captures (section 4, Fig. 5 to 10)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps, overview_frame
from usdbrdf.asset.readers.views import Views, photographs_of_views
from usdbrdf.capture.checks import spread_evenly
from usdbrdf.evaluation import metrics, report
from usdbrdf.evaluation.compare_assets import Relit, agreement
from usdbrdf.evaluation.evaluate_views import (
    exposure_of_views,
    measured_atlas,
    scored_views,
    viewed_asset,
)
from usdbrdf.files.atomic import environment_failures
from usdbrdf.files.images import write_preview_png
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.ownership import reads_asset
from usdbrdf.model.camera import Camera
from usdbrdf.paper import figures, tables
from usdbrdf.paper.options import PaperOptions
from usdbrdf.paper.text import paper_text
from usdbrdf.transport.denoise import chosen_filter
from usdbrdf.transport.rays import RayScene

DOCUMENT = "paper.json"
NAMES = ("a", "b")
# Views that figures 5 to 7 are shown from.
_CAMERAS = 3


@dataclass(frozen=True, kw_only=True)
class _Side:
    """One of the two assets, the views that it is asked of, and how it compares with the truth."""

    place: Asset
    atlas: AssetMaps
    views: Views
    truth: dict[str, Any] | None


@reads_asset("first", "second")
def write_paper(
    first: str | Path, second: str | Path, output: str | Path, options: PaperOptions | None = None
) -> dict[str, Any]:
    """Write the paper's tables and figures of two assets of the same geometry into ``output``.

    first, second  asset folders, A and B; only read
    output         folder for paper.md, paper.json, tables/*.csv and figures/*
    returns        the content of paper.json

    Raises UsdBrdfError; ``output`` is then as it was.
    """
    chosen = options or PaperOptions()
    place_a, a = measured_atlas(Path(first), chosen.compare.lighting)
    place_b, b = measured_atlas(Path(second), chosen.compare.other_lighting)
    asked = ((place_a, a, chosen.views), (place_b, b, chosen.other_views))
    with (
        report.output_folder(Path(output), DOCUMENT, (place_a, place_b)) as work,
        scratch_folder() as folder,
    ):
        if chosen.relight:
            chosen_filter(chosen.denoise)
        # What may be refused is read before the first figure is made.
        sides = [
            _side(*each, chosen, folder / name) for name, each in zip(NAMES, asked, strict=True)
        ]
        with environment_failures(str(work)):
            (work / "tables").mkdir()
            (work / "figures").mkdir()
        found, pair = agreement(a, b, (place_a.name, place_b.name))
        found["materials"] = tables.material_rows(a, b)
        _write_agreement(work, found, pair)
        found["views"] = [
            _score(work, name, side, chosen) for name, side in zip(NAMES, sides, strict=True)
        ]
        found["relighting"] = None
        if chosen.relight:
            camera, places = _overview_camera(pair[0]), (sides[0].place, sides[1].place)
            found["relighting"] = figures.write_relit(
                work / "figures/fig10_relighting.png", places, camera, chosen
            )
        report.write_prose(work / "paper.md", paper_text(found, report.files_of(work)))
        report.write_document(work, DOCUMENT, found)
    return found


def _write_agreement(work: Path, found: dict[str, Any], pair: tuple[Relit, Relit]) -> None:
    """Figures 5 to 7 and their tables."""
    rows = {
        "albedo": tables.albedo_rows(found),
        "objects": found["objects"],
        "materials": found["materials"],
    }
    for name, own in rows.items():
        report.write_table(work / f"tables/{name}.csv", own)
    frames = pair[0].atlas.frames
    seen = figures.seen_by(pair, frames.at(spread_evenly(len(frames), _CAMERAS)))
    for name, sheet in (
        ("fig5_errors", figures.errors_sheet(pair, seen)),
        ("fig6_albedo_shading", figures.prediction_sheet(pair, seen)),
        ("fig7_textures", figures.texture_sheet(pair, seen)),
    ):
        write_preview_png(work / f"figures/{name}.png", sheet)


def _side(
    place: Asset, atlas: AssetMaps, document: Path | None, options: PaperOptions, folder: Path
) -> _Side:
    """folder: for frames of lenses"""
    own, how = place.in_lighting(atlas.lighting or None), options.evaluate
    atlas.environment(how.environment)  # which may be refused
    truth = None
    if how.truth is not None:
        albedo = atlas.first_of("base_color", "albedo")
        truth = metrics.compare_with_truth(atlas, how.truth, how.mesh, albedo)
    folder.mkdir()
    views = _views(own, atlas, document, options, folder)
    return _Side(place=own, atlas=atlas, views=views, truth=truth)


def _score(work: Path, name: str, side: _Side, options: PaperOptions) -> dict[str, Any]:
    """Figures 8 and 9 of one asset, their table, and what they come to."""
    found = viewed_asset(side.place, side.atlas, options.evaluate.environment)
    shown, rows, exposure = figures.TellingViews(), [], exposure_of_views(side.views.frames)
    for view in scored_views(found, side.views, exposure, options.evaluate):
        rows.append(view.row)
        shown.see(view)
    report.write_table(work / f"tables/views_{name}.csv", rows)
    for suffix in ("png", "svg"):
        report.write_plot(work / f"figures/fig8_{name}.{suffix}", rows)
    write_preview_png(work / f"figures/fig9_{name}.png", figures.views_sheet(shown.chosen()))
    return {
        **({} if side.truth is None else {"truth": side.truth}),
        "summary": report.summary_of_views(rows),
        "changes": tables.changes(rows),
        "shown": [view.row["view"] for view in shown.chosen()],
        "rows": rows,
    }


def _views(
    place: Asset, atlas: AssetMaps, document: Path | None, options: PaperOptions, folder: Path
) -> Views:
    """Those of the document that was named, which may need ``folder`` for frames of lenses, else
    the capture's frames, spread evenly."""
    if document is not None:
        return photographs_of_views(
            document, place, atlas.stage, atlas.scene, folder, options.evaluate.allow_outside
        )
    frames = atlas.frames
    taken = spread_evenly(len(frames), options.frames)
    return Views(names=tuple(frames.image_paths[i].name for i in taken), frames=frames.at(taken))


def _overview_camera(relit: Relit) -> Camera:
    """Of the frame of A that shows the most objects."""
    scene, frames = relit.atlas.scene, relit.atlas.frames
    camera = frames.camera(overview_frame(scene, RayScene(scene.points, scene.triangles), frames))
    return camera.at_width(min(camera.width, figures.MOST_ACROSS))
