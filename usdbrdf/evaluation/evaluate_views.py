"""Views of an asset predicted by the paper's image model (eq. 1, 2) and by its baseline, and
compared with photographs: a row of figures and a sheet of pictures per view, and what is said of
all of them.

baseline   I = L_d                          the lit texture, the same from everywhere
full       I = diffuse + I_nd(phi, psi)     one specular bounce of the lit texture
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.preview_lobe import BECKMANN_FACETS
from usdbrdf.asset.readers.compose import open_measured, refuse_missing
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.asset.readers.views import Views, photographs_of_views
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation import metrics, report
from usdbrdf.files.colour import display_exposure, to_display_srgb
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import write_preview_png
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.job.ownership import reads_asset
from usdbrdf.job.progress import progress, warn
from usdbrdf.model.arrays import Bool, Float
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.options import EvaluateOptions, Surroundings
from usdbrdf.transport.brdf import DIELECTRIC, PAPER
from usdbrdf.transport.environment import radiance_from, unknown_primaries
from usdbrdf.transport.let_through import share_let_through
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, past_panes, visible_points
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.surface_texture import SurfaceTexture

DOCUMENT = "evaluation.json"
MODELS = ("baseline", "full")
# Surface points of a picture at once: what bounds the memory.
_POINTS_AT_ONCE = 1 << 20
# Cameras and renderers smear a lamp over this many pixels around it.
_LAMP_MARGIN = 2
# Pixels of all photographs together that the exposure is taken from, at most.
_EXPOSURE_PIXELS = 1 << 24
# Points of a photograph's own pixels across one of a reduced picture, at most: what bounds time.
_POINTS_ACROSS = 2
# Pixels of views that wait for FLIP together, at most: what bounds the memory.
_WAITING_PIXELS = 1 << 23


@reads_asset("asset")
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
    place, atlas = measured_atlas(Path(asset), chosen.lighting)
    with report.output_folder(Path(output), DOCUMENT, (place,)) as work, scratch_folder() as folder:
        # What may be refused is read before all photographs are.
        seen = viewed_asset(place, atlas, chosen.environment)
        known = {}
        if chosen.truth is not None:
            albedo = atlas.first_of("base_color", "albedo")
            known = {"truth": metrics.compare_with_truth(atlas, chosen.truth, chosen.mesh, albedo)}
        photographs = photographs_of_views(
            Path(views), place, atlas.stage, atlas.scene, folder, chosen.allow_outside
        )
        exposure = exposure_of_views(photographs.frames)
        rows = score_views(work / "pictures", seen, photographs, exposure, chosen)
        report.write_table(work / "evaluation.csv", rows)
        report.write_plot(work / "evaluation.png", rows)
        found = {
            "asset": place.name,
            **({"lighting": atlas.lighting} if atlas.lighting else {}),
            "views": Path(views).name,
            "samples_per_pixel": chosen.samples_per_pixel,
            "rays": chosen.rays,
            "seed": chosen.seed,
            "exposure": exposure,
            "diffuse_map": atlas.first_of("diffuse", "lit"),
            "summary": report.summary_of_views(rows),
            "frames": rows,
            **known,
        }
        report.write_document(work, DOCUMENT, found)
    return found


def measured_atlas(folder: Path, lighting: str | None = None) -> tuple[Asset, AssetMaps]:
    """The maps of an asset that all steps have been through, without the artist's layer.
    InputRefused for one that others cannot open, whatever was measured."""
    asset = Asset.made(folder).in_lighting(lighting)
    refuse_missing(asset, 1 + len(ROLES))
    return asset, AssetMaps(open_measured(asset))


def exposure_of_views(frames: Frames) -> float:
    """One exposure for all views: 90 % of their known pixels come out below 0.8, linear."""
    stride = -(-int(frames.resolution.astype(np.int64).prod(axis=1).sum()) // _EXPOSURE_PIXELS)
    levels = []
    for i in range(len(frames)):
        level = read_frame(frames, i).radiance.mean(axis=2).ravel()[::stride]
        levels.append(level[np.isfinite(level)])
    return display_exposure(np.concatenate(levels))


def score_views(
    folder: Path, seen: ViewedAsset, views: Views, exposure: float, options: EvaluateOptions
) -> list[report.Row]:
    """A row per view; a sheet per view and FLIP maps per model are written to ``folder``."""
    folder.mkdir()
    rows: list[report.Row] = []
    for view in scored_views(seen, views, exposure, options):
        rows.append(view.row)
        _write_pictures(folder, view)
    return rows


@dataclass(frozen=True, kw_only=True)
class ScoredView:
    """A view beside its photograph: a row of figures, display pictures in [0, 1] of the photograph
    and, by the models' names, of both models, (H, W, 3), the pixels that count, (H, W), and FLIP's
    maps (H, W) of both models.

    The row holds, per model, relative L2 without lamps, with them, and without them after radiance
    that is shown white is cut off; PSNR and mean FLIP of the display pictures; and the shares of
    pixels that are compared and that show a lamp. A pixel counts if the photograph knows it in
    every channel and all of it shows the asset; what does not count is made equal to the
    photograph before FLIP. Infinite PSNR (equal pictures) is None.
    """

    row: report.Row
    reference: Float
    shown: dict[str, Float]
    counted: Bool
    errors: dict[str, Float]


def scored_views(
    seen: ViewedAsset,
    views: Views,
    exposure: float,
    options: EvaluateOptions,
    widths: Sequence[int] = (),
) -> Iterator[ScoredView]:
    """All views in their order.

    widths  of the pictures that are compared, in pixels: larger photographs are reduced; () for
            the photographs' own
    """
    for batch in _batches(seen, views, exposure, options, widths):
        pairs = [
            metrics.Pair(view.reference, view.shown[model]) for view in batch for model in MODELS
        ]
        maps = iter(metrics.flip_maps(pairs, f"{len(batch)} views"))
        for view in batch:
            errors = {model: next(maps) for model in MODELS}
            row = dict(view.row)
            for model in MODELS:
                values = errors[model][view.counted]
                mean = values.mean(dtype=np.float64) if values.size else np.nan
                row[f"flip_{model}"] = metrics.finite(mean)
            yield replace(view, row=row, errors=errors)


def _batches(
    seen: ViewedAsset,
    views: Views,
    exposure: float,
    options: EvaluateOptions,
    widths: Sequence[int],
) -> Iterator[list[ScoredView]]:
    """Views that wait for FLIP."""
    waiting: list[ScoredView] = []
    frames = views.frames
    for i in progress(range(len(frames)), total=len(frames), label="evaluate", unit="views"):
        camera, photograph, asked = frames.camera(i), read_frame(frames, i), options
        if widths and widths[i] < camera.width:
            # A pixel of a reduced photograph is the mean of many: one point of it would show
            # patterns that the mean has lost, and the sharper model would look the worse.
            points = min(math.ceil(camera.width / widths[i]), _POINTS_ACROSS) ** 2
            asked = replace(
                options,
                samples_per_pixel=options.samples_per_pixel * points,
                rays=options.rays * points,
            )
            camera = camera.at_width(widths[i])
            photograph = photograph.at_size(camera.width, camera.height)
        predicted = predict_view(seen, camera, asked, options.seed + (i << 16))
        counted = photograph.valid & predicted.surface
        measured = photograph.radiance
        reference = to_display_srgb(np.nan_to_num(measured), exposure_scale=exposure)
        dim = counted & ~ndimage.binary_dilation(predicted.lamp, np.ones((3, 3)), _LAMP_MARGIN)
        shown = {}
        row: dict[str, Any] = {"number": i, "view": views.names[i]}
        for model, image in zip(MODELS, (predicted.baseline, predicted.full), strict=True):
            display = to_display_srgb(image, exposure_scale=exposure)
            cut, cut_measured = (np.minimum(x * exposure, 1) for x in (image, measured))
            scores = {
                "l2": metrics.relative_l2(image, measured, dim),
                "l2_with_lamps": metrics.relative_l2(image, measured, counted),
                "l2_shown": metrics.relative_l2(cut, cut_measured, dim),
                "psnr": metrics.psnr(display, reference, counted),
            }
            row.update({f"{key}_{model}": metrics.finite(x) for key, x in scores.items()})
            shown[model] = np.where(counted[..., None], display, reference)
        row["compared"] = metrics.finite(counted.mean())
        row["lamps"] = metrics.finite(predicted.lamp.mean())
        waiting.append(
            ScoredView(row=row, reference=reference, shown=shown, counted=counted, errors={})
        )
        if sum(scored.counted.size for scored in waiting) >= _WAITING_PIXELS:
            yield waiting
            waiting = []
    if waiting:
        yield waiting


def _write_pictures(folder: Path, view: ScoredView) -> None:
    """NAME.png: photograph, baseline, full above what changed and their FLIP maps; and the maps."""
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", Path(view.row["view"]).stem)[:80]
    name = f"{view.row['number']:04d}_{stem}"
    maps = {model: report.magma(view.errors[model], view.counted) for model in MODELS}
    for model, picture in maps.items():
        write_preview_png(folder / f"{name}.flip_{model}.png", picture)
    displayed = (view.reference, *(view.shown[model] for model in MODELS))
    above = [(picture * 255 + 0.5).astype(np.uint8) for picture in displayed]
    changed = report.change(view.errors["baseline"], view.errors["full"], view.counted)
    write_preview_png(folder / f"{name}.png", report.sheet([above, [changed, *maps.values()]]))


@dataclass(frozen=True, kw_only=True)
class ViewedAsset:
    """What is seen: the scene with its light; L_d, and L_d without specular light, on the surface;
    the lobe of each object, phi (num_objects,) and psi (num_objects, 3), NaN for none; and the
    numbers of the objects whose material is no clear glass, though they may let light through."""

    lit: LitScene
    measured: SurfaceTexture
    diffuse: SurfaceTexture
    phi: Float
    psi: Float
    shown: tuple[int, ...] = ()


def viewed_asset(asset: Asset, atlas: AssetMaps, environment: Surroundings) -> ViewedAsset:
    """Its light, its diffuse radiance (``diffuse``, else ``lit``), its lobes as the fit left them.

    environment  the light from outside, see ``AssetMaps.environment``
    """
    read = [read_fit(atlas.stage, obj.prim_path) for obj in atlas.scene.objects]
    fits = [fit for fit in read if fit is not None]
    if len(fits) < len(read):
        raise InputRefused(
            f"{asset.folder}: its objects have no roughness and specular yet. Run `usdbrdf fit` "
            "first. [asset.incomplete]"
        )
    kind = DIELECTRIC if any(fit.lobe != "paper" for fit in fits) else PAPER
    beckmann = np.array([fit.lobe == BECKMANN_FACETS for fit in fits], np.bool_)
    surfaces = atlas.lit_scene(atlas.environment(environment))
    if isinstance(environment, Path) and (unknown := unknown_primaries(environment)):
        warn(unknown)
    lit = replace(surfaces, lobe=kind, beckmann=beckmann)
    diffuse = atlas.map_where_present(atlas.first_of("diffuse", "lit"), 3)
    return ViewedAsset(
        lit=lit,
        measured=lit.radiance.showing(atlas.texels, atlas.map("lit")),
        diffuse=lit.radiance.showing(atlas.texels, diffuse),
        phi=np.array([fit.phi for fit in fits], np.float32),
        psi=np.array([fit.psi_of_channels for fit in fits], np.float32),
        shown=tuple(i for i, fit in enumerate(fits) if not fit.is_glass),
    )


@dataclass(frozen=True, kw_only=True)
class PredictedView:
    """baseline, full (H, W, 3) radiance, pixels averaged over their sub-pixels; surface (H, W):
    all of the pixel shows the asset; lamp (H, W): some of it shows an emitter."""

    baseline: Float
    full: Float
    surface: Bool
    lamp: Bool


def predict_view(
    seen: ViewedAsset, camera: Camera, options: EvaluateOptions, seed: int
) -> PredictedView:
    """One picture by both models, box-filtered over ``samples_per_pixel`` points, which share the
    rays for I_nd."""
    per_pixel, width, height = options.samples_per_pixel, camera.width, camera.height
    at_once = max(1, _POINTS_AT_ONCE // (width * per_pixel))
    offset = (np.arange(options.per_side) + 0.5) / options.per_side
    bands = []
    for top in range(0, height, at_once):
        # Pixel by pixel, row by row, all points of each.
        lines = np.arange(top, min(top + at_once, height))
        rows, columns, down, right = np.meshgrid(
            lines, np.arange(width), offset, offset, indexing="ij"
        )
        pixels = np.stack([columns + right, rows + down], axis=-1).reshape(-1, 2)
        points = visible_points(seen.lit, camera, pixels)
        rays = max(1, options.rays // per_pixel)
        values = _radiance_at(seen, points, rays, per_pixel, seed + top)
        bands.append(values.reshape(-1, width, per_pixel, values.shape[1]).mean(axis=2))
    picture = np.concatenate(bands).astype(np.float32)
    return PredictedView(
        baseline=picture[..., :3],
        full=picture[..., 3:6],
        surface=picture[..., 6] > 1 - 0.5 / per_pixel,
        lamp=picture[..., 7] > 0,
    )


def _radiance_at(
    seen: ViewedAsset, points: SurfacePoints, rays: int, per_pixel: int, seed: int
) -> Float:
    """(R, 8): baseline, full, 1 on the surface, 1 on an emitter; ``points`` pixel after pixel."""
    values = np.zeros((len(points.face), 8), np.float32)
    values[:, :3] = seen.measured.at(points.face, points.u, points.v)
    values[:, 6] = points.face >= 0
    first, points = points, past_panes(seen.lit, points, seen.shown)
    outside = (first.face >= 0) & (points.face < 0)
    hit = points.face >= 0
    place = points.face, points.u, points.v
    lamp = hit & seen.lit.emits(points)
    shines = values[:, :3] if points is first else seen.measured.at(*place)
    values[:, 3:6] = np.where(lamp[:, None], shines, seen.diffuse.at(*place))
    values[outside, 3:6] = radiance_from(seen.lit.environment, -points.to_camera[outside])
    values[:, 7] = lamp
    owner = seen.lit.owner(points.face)
    known = np.isfinite(seen.phi) & np.isfinite(seen.psi).all(axis=1)
    reflects = np.flatnonzero(hit & ~lamp & known[owner])
    owner, shown = owner[reflects], points.take(reflects)
    phi, psi = seen.phi[owner], seen.psi[owner]
    if seen.lit.lobe == DIELECTRIC:
        cosine = (shown.normal * shown.to_camera).sum(axis=1)
        values[reflects, 3:6] *= share_let_through(phi, psi, cosine)[:, None]
    values[reflects, 3:6] += lobe_radiance(
        seen.lit, shown, phi, psi, rays, seed, reflects, per_pixel
    )
    return values
