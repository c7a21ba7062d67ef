"""One asset's albedo under another's light: the paper's cross-check (section 4.2, Fig. 5 and 6)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.previews import camera_hits
from usdbrdf.evaluation.correspondence import Correspondence, correspondence
from usdbrdf.evaluation.metrics import exposure_of, finite, median_relative, nrmse
from usdbrdf.evaluation.pictures import magma, sheet
from usdbrdf.evaluation.truth import MIN_SAMPLES
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import write_preview_png
from usdbrdf.job.progress import progress
from usdbrdf.model.arrays import Bool, Byte, Float
from usdbrdf.model.capture import Frames
from usdbrdf.transport.rays import Hits, RayScene
from usdbrdf.transport.surface_texture import surface_texture


@dataclass(frozen=True, kw_only=True)
class MapNames:
    """Which maps are the diffuse radiance, the irradiance and the albedo."""

    radiance: str
    irradiance: str
    albedo: str


@dataclass(frozen=True, kw_only=True)
class Relit:
    """On the texels of one asset, (T, 3) each: its radiance, the radiance predicted with the other
    asset's albedo, both albedos; the texels that are compared, (T,) bool."""

    atlas: AssetMaps
    measured: Float
    predicted: Float
    albedo: Float
    other_albedo: Float
    scored: Bool


def matched(atlas: AssetMaps, other: AssetMaps) -> tuple[Correspondence, Bool]:
    """The other asset's texels on those of ``atlas``, and which are compared: (T,) bool, seen at
    least three times, inside a triangle and without emission, in both."""
    same = correspondence(atlas.scene, atlas.texels, other.scene, other.texels)
    there = np.asarray(same.nearest(_comparable(other)), np.bool_)
    return same, _comparable(atlas) & there & same.known()


def relit(
    atlas: AssetMaps, other: AssetMaps, same: Correspondence, scored: Bool, maps: MapNames
) -> Relit:
    """Predict the radiance of ``atlas`` with the albedo of ``other``."""
    theirs = same.interpolated(other.map_where_present(maps.albedo, 3))
    measured = atlas.map_where_present(maps.radiance, 3)
    reflected = atlas.map(maps.irradiance) * theirs / np.pi
    # Lamps are given: what is predicted is what they light.
    emits = atlas.map_where_present("emission", 3).any(axis=1, keepdims=True)
    return Relit(
        atlas=atlas,
        measured=measured,
        predicted=np.where(emits, measured, reflected).astype(np.float32),
        albedo=atlas.map_where_present(maps.albedo, 3),
        other_albedo=theirs,
        scored=scored,
    )


def errors(reference: Float, values: Float, area: Float, part: Bool) -> dict[str, float | None]:
    """NRMSE and median relative errors over the texels of ``part``."""
    absolute, signed = median_relative(values[part], reference[part])
    return {
        "nrmse": finite(nrmse(values[part], reference[part], area[part])),
        "median_abs_relative": finite(absolute),
        "median_signed": finite(signed),
    }


def _comparable(atlas: AssetMaps) -> Bool:
    seen = atlas.map("samples")[:, 0] >= MIN_SAMPLES
    emits = (atlas.map_where_present("emission", 3) > 0).any(axis=1)
    return np.asarray(seen & ~emits & atlas.texels.interior, np.bool_)


_CAMERAS = 4

_MAX_WIDTH = 480

# Errors of this share of the reference, or more, are shown palest.
_FULL_ERROR = 0.25


def write_pictures(folder: Path, forth: Relit, back: Relit, frames: Frames) -> None:
    """A sheet for each of four cameras spread over ``frames``. Its rows: radiance of asset A
    measured, predicted, error; the same of asset B; albedo of A, of B, difference."""
    folder.mkdir()
    chosen = np.unique(np.linspace(0, len(frames) - 1, _CAMERAS).round().astype(int))
    scenes = [RayScene(r.atlas.scene.points, r.atlas.scene.triangles) for r in (forth, back)]
    shown = [exposure_of(r.measured[r.scored].mean(axis=1)) for r in (forth, back)]
    for i in progress(chosen, total=len(chosen), label="pictures", unit="views"):
        width, height = (int(n) for n in frames.resolution[i])
        scale = min(1.0, _MAX_WIDTH / width)
        size = max(1, round(scale * width)), max(1, round(scale * height))
        hits = [camera_hits(rays, frames, int(i), *size) for rays in scenes]
        rows = [
            _row(relit, seen, size, (relit.measured, relit.predicted), exposure)
            for relit, seen, exposure in zip((forth, back), hits, shown, strict=True)
        ]
        albedos = forth.albedo, forth.other_albedo
        rows.append(_row(forth, hits[0], size, albedos, 1.0))
        write_preview_png(folder / f"{int(i):04d}.png", sheet(rows))


def _row(
    relit: Relit, hits: Hits, size: tuple[int, int], maps: tuple[Float, Float], exposure: float
) -> list[Byte]:
    """Reference, what is compared with it, and the error relative to the reference."""
    width, height = size
    reference, values = (_seen(relit, hits, m).reshape(height, width, 3) for m in maps)
    scored = np.repeat(relit.scored[:, None], 3, axis=1).astype(np.float32)
    counted = _seen(relit, hits, scored)[:, 0].reshape(height, width) > 0.5
    error = np.abs(values - reference).mean(axis=2)
    relative = error / np.maximum(reference.mean(axis=2), 1e-6)
    pictures = [to_display_srgb8(m, exposure_scale=exposure) for m in (reference, values)]
    return [*pictures, magma((relative / _FULL_ERROR).astype(np.float32), counted)]


def _seen(relit: Relit, hits: Hits, values: Float) -> Float:
    texture = surface_texture(relit.atlas.texels, relit.atlas.scene.face_object, values)
    return texture.at(hits.face, hits.u, hits.v)
