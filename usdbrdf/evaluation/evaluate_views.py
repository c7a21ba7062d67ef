"""Views of an asset rendered and compared with photographs: diffuse baseline and full model."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from usdbrdf.evaluation.pictures import write_plot
from usdbrdf.evaluation.report import FILES, files_of, output_folder, summary_of_views, table_text
from usdbrdf.evaluation.score_views import Quality, exposure_of_views, score_views
from usdbrdf.evaluation.truth import compare_with_truth
from usdbrdf.evaluation.viewed_asset import map_or, measured_atlas, viewed_asset
from usdbrdf.evaluation.views_from_file import views_from_file
from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.files.documents import write_json
from usdbrdf.options import EvaluateOptions

DOCUMENT = "evaluation.json"


def evaluate(
    asset: str | Path, views: str | Path, output: str | Path, options: EvaluateOptions | None = None
) -> dict[str, Any]:
    """Render the views of a document from an asset, write figures and pictures to ``output``.

    asset    asset folder; only read
    views    nerfstudio document (transforms.json, views.json) of views of the asset's capture
    output   folder for evaluation.json, evaluation.csv, evaluation.png and pictures/
    returns  the content of evaluation.json

    Raises UsdBrdfError; ``output`` is then as it was.
    """
    chosen = options or EvaluateOptions()
    place, atlas = measured_atlas(Path(asset))
    with output_folder(Path(output), DOCUMENT, (place.folder,)) as work:
        known = {}
        if chosen.truth is not None:
            albedo = map_or(atlas, "base_color", "albedo")
            known = {"truth": compare_with_truth(atlas, chosen.truth, chosen.mesh, albedo)}
        photographs = views_from_file(
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
