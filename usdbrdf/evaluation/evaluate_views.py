"""Views of an asset rendered and compared with photographs: diffuse baseline and full model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from usdbrdf.errors import UsageError
from usdbrdf.evaluation.pictures import write_plot
from usdbrdf.evaluation.report import FILES, files_of, output_folder, summary_of_views, table_text
from usdbrdf.evaluation.score_views import Quality, exposure_of_views, score_views
from usdbrdf.evaluation.truth import compare_with_truth
from usdbrdf.evaluation.viewed_asset import map_or, measured_atlas, viewed_asset
from usdbrdf.evaluation.views_from_file import views_from_file
from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.files.documents import write_json

DOCUMENT = "evaluation.json"


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """How views are rendered, and what else is compared.

    samples_per_pixel points that a pixel is the mean of, a square number
    rays              per pixel, for the specular light
    environment       latitude-longitude picture of the surroundings; None: black
    truth             folder with objects.json and albedo_vertex.npz
    mesh              the mesh that the truth's vertices belong to; None: mesh.ply beside ``truth``
    allow_outside     folders that the views' document may point into
    """

    samples_per_pixel: int = 9
    rays: int = 144
    environment: Path | None = None
    seed: int = 0
    truth: Path | None = None
    mesh: Path | None = None
    allow_outside: tuple[Path, ...] = ()

    def __post_init__(self) -> None:
        if self.samples_per_pixel < 1 or self.per_side**2 != self.samples_per_pixel:
            raise UsageError(
                f"--samples-per-pixel {self.samples_per_pixel}: not a square number (1, 4, 9, "
                "16, ...). [usage.option]"
            )
        if self.rays < 8 * self.samples_per_pixel:
            raise UsageError(
                f"--rays {self.rays}: at least 8 for each of a pixel's points are needed, here "
                f"{8 * self.samples_per_pixel}. [usage.option]"
            )
        if self.mesh is not None and self.truth is None:
            raise UsageError("--mesh: belongs to --truth, which is not given. [usage.option]")

    @property
    def per_side(self) -> int:
        """Points along a side of a pixel."""
        return math.isqrt(max(self.samples_per_pixel, 0))


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
