"""The paper's figures 5 to 7, 9 and 10 as sheets of pictures, (H, W, 3) sRGB bytes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import camera_hits
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.render_scene import RenderScene, render_scene_from_stage, time_code
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.evaluation.compare_assets import Relit, error_picture, on_surface
from usdbrdf.evaluation.evaluate_views import MODELS, ScoredView
from usdbrdf.evaluation.metrics import finite, relative_l2
from usdbrdf.evaluation.report import magma, sheet
from usdbrdf.files.colour import display_exposure, to_display_srgb8
from usdbrdf.files.images import resized, write_preview_png
from usdbrdf.job.progress import say, warn
from usdbrdf.model.arrays import Byte, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.light import RelitScene
from usdbrdf.paper.options import PaperOptions
from usdbrdf.relighting.relit_scene import lit_by_others
from usdbrdf.relighting.render import mitsuba_scene, mitsuba_variant, render_view
from usdbrdf.transport.denoise import OIDN, chosen_filter, denoise_picture
from usdbrdf.transport.rays import Hits, RayScene

# Pixels across each picture of a sheet.
MOST_ACROSS = 480
# A display value that is off by this much is shown palest in maps of the L2 error.
_FULL_L2 = 0.25
_BOUNCES = 16

Seen = Sequence[tuple[tuple[int, int], tuple[Hits, Hits]]]


def seen_by(pair: tuple[Relit, Relit], frames: Frames) -> Seen:
    """Per frame the size (W, H) of its pictures and what is behind their pixels in A and in B."""
    scenes = [RayScene(r.atlas.scene.points, r.atlas.scene.triangles) for r in pair]
    seen = []
    for i in range(len(frames)):
        camera = frames.camera(i)
        camera = camera.at_width(min(camera.width, MOST_ACROSS))
        size = camera.width, camera.height
        first, second = (camera_hits(rays, frames, i, *size) for rays in scenes)
        seen.append((size, (first, second)))
    return seen


def errors_sheet(pair: tuple[Relit, Relit], seen: Seen) -> Byte:
    """Fig. 5: relative errors of rho_B against rho_A, of S_A rho_B and of S_B rho_A against what
    was measured."""
    a, b = pair
    return _sheet(
        [
            error_picture(a, hits[0], size, (a.albedo, a.other_albedo)),
            error_picture(a, hits[0], size, (a.measured, a.predicted)),
            error_picture(b, hits[1], size, (b.measured, b.predicted)),
        ]
        for size, hits in seen
    )


def prediction_sheet(pair: tuple[Relit, Relit], seen: Seen) -> Byte:
    """Fig. 6: albedo, shading, measured radiance and the one predicted with the other's albedo;
    rows of A and of B in turn."""
    return _sheet(
        _shown(one, hits[i], size, ("albedo", "irradiance", "measured", "predicted"))
        for size, hits in seen
        for i, one in enumerate(pair)
    )


def texture_sheet(pair: tuple[Relit, Relit], seen: Seen) -> Byte:
    """Fig. 7: lit diffuse radiance, albedo, shading; rows of A and of B in turn."""
    return _sheet(
        _shown(one, hits[i], size, ("measured", "albedo", "irradiance"))
        for size, hits in seen
        for i, one in enumerate(pair)
    )


def _shown(one: Relit, hits: Hits, size: tuple[int, int], names: Sequence[str]) -> list[Byte]:
    """Maps on the surface: albedo as it is, what was predicted exposed as what was measured."""
    pictures = []
    for name in names:
        values: Float = getattr(one, name)
        of = one.measured if name == "predicted" else values
        exposure = 1.0 if name == "albedo" else display_exposure(of[one.scored].mean(axis=1))
        shown = on_surface(one, hits, size, np.nan_to_num(values))
        pictures.append(to_display_srgb8(shown, exposure_scale=exposure))
    return pictures


def _sheet(rows: Any) -> Byte:
    """Rows of pictures below each other, all in cells of the first one's size."""
    listed = [list(row) for row in rows]
    height, width = listed[0][0].shape[:2]
    return sheet([[_in_cell(picture, width, height) for picture in row] for row in listed])


def _in_cell(picture: Byte, width: int, height: int) -> Byte:
    """As large as fits into a cell, with white about it."""
    tall, wide = picture.shape[:2]
    if (tall, wide) == (height, width):
        return picture
    scale = min(width / wide, height / tall)
    wide, tall = max(1, round(wide * scale)), max(1, round(tall * scale))
    scaled = resized(picture.astype(np.float32), wide, tall)
    cell = np.full((height, width, 3), 255, np.uint8)
    top, left = (height - tall) // 2, (width - wide) // 2
    cell[top : top + tall, left : left + wide] = np.clip(scaled + 0.5, 0, 255)
    return cell


class TellingViews:
    """Of views seen one after the other: the first, the one that the full model improves most by
    FLIP, the one that it harms most or helps least, and the last; each once, no others are kept."""

    def __init__(self) -> None:
        self._kept: dict[str, tuple[float, ScoredView]] = {}

    def see(self, view: ScoredView) -> None:
        pair = [view.row[f"flip_{model}"] for model in MODELS]
        gain = pair[0] - pair[1] if None not in pair else 0.0
        held, kept = self._kept, (gain, _reduced(view))
        held.setdefault("first", kept)
        if "best" not in held or gain > held["best"][0]:
            held["best"] = kept
        if "worst" not in held or gain < held["worst"][0]:
            held["worst"] = kept
        held["last"] = kept

    def chosen(self) -> list[ScoredView]:
        views = [self._kept[name][1] for name in ("best", "worst", "first", "last")]
        numbers = [view.row["number"] for view in views]
        return [view for i, view in enumerate(views) if numbers.index(numbers[i]) == i]


def _reduced(view: ScoredView) -> ScoredView:
    """The same as large as sheets show it; a pixel counts if half of what it covers does."""
    height, width = view.counted.shape
    if width <= MOST_ACROSS:
        return view
    size = MOST_ACROSS, max(1, round(height * MOST_ACROSS / width))

    def smaller(values: Float) -> Float:
        return resized(values, *size)

    return replace(
        view,
        reference=smaller(view.reference),
        shown={model: smaller(picture) for model, picture in view.shown.items()},
        counted=smaller(view.counted[..., None].astype(np.float32))[..., 0] > 0.5,
        errors={model: smaller(flip[..., None])[..., 0] for model, flip in view.errors.items()},
    )


def views_sheet(views: Sequence[ScoredView]) -> Byte:
    """Fig. 9: photograph, diffuse baseline and full model; L2 errors of both, FLIP of both."""
    return _sheet(_view_row(view) for view in views)


def _view_row(view: ScoredView) -> list[Byte]:
    displayed = (view.reference, *(view.shown[model] for model in MODELS))
    pictures = [np.asarray(each * 255 + 0.5, np.uint8) for each in displayed]
    for model in MODELS:
        away = np.linalg.norm(view.shown[model] - view.reference, axis=2) / np.sqrt(3)
        pictures.append(magma((away / _FULL_L2).astype(np.float32), view.counted))
    return [*pictures, *(magma(view.errors[model], view.counted) for model in MODELS)]


def write_relit(
    path: Path, assets: tuple[Asset, Asset], camera: Camera, options: PaperOptions
) -> dict[str, Any] | None:
    """Fig. 10: both assets path traced, in their own light and in the other's. Returns how far the
    other's albedo and materials are from its own, in its own light, as relative L2 over all pixels;
    None without Mitsuba, which one line says."""
    try:
        mitsuba = mitsuba_variant()
    except EnvironmentFailure as error:
        say(f"{path.name}: not drawn. {error}")
        return None
    scenes = [_scene_of(asset) for asset in assets]
    filtered = chosen_filter(options.denoise) == OIDN
    radiance: dict[tuple[int, int], Float] = {}
    for i, own in enumerate(scenes):
        for j, light in enumerate(scenes):
            lit = RelitScene(surfaces=own.surfaces, lights=own.lights)
            if i != j:
                glowing = [s for s in light.surfaces if s.material.emits]
                lit = lit_by_others(lit, glowing, light.lights, keep_emitters=False)
            loaded = mitsuba_scene(mitsuba, lit, bounces=_BOUNCES)
            label = f"fig. 10, {'AB'[i]} in the light of {'AB'[j]}"
            seed = options.evaluate.seed, j  # equal noise in what is compared
            made = render_view(
                mitsuba, loaded, camera, samples=options.samples, seed=seed, label=label
            )
            radiance[i, j] = denoise_picture(*made) if filtered else made[0]
    exposures = [display_exposure(radiance[i, i].mean(axis=2).ravel()) for i in range(2)]
    rows = [
        [to_display_srgb8(radiance[i, j], exposure_scale=exposures[j]) for j in range(2)]
        for i in range(2)
    ]
    write_preview_png(path, sheet(rows))
    everywhere = np.ones(radiance[0, 0].shape[:2], np.bool_)
    return {
        "samples": options.samples,
        "variant": mitsuba.variant(),
        "a_in_light_of_b": finite(relative_l2(radiance[0, 1], radiance[1, 1], everywhere)),
        "b_in_light_of_a": finite(relative_l2(radiance[1, 0], radiance[0, 0], everywhere)),
    }


def _scene_of(asset: Asset) -> RenderScene:
    """As it was measured, as all other figures show it: without the artist's edits."""
    stage = open_measured(asset)
    return render_scene_from_stage(stage, time_code(stage, None), warn)
