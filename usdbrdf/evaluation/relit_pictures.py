"""Pictures of a cross-check, as the paper's Fig. 5 and 6, from cameras of the capture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from usdbrdf.evaluation.metrics import exposure_of
from usdbrdf.evaluation.pictures import magma, sheet
from usdbrdf.evaluation.relit import Relit
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import write_preview_png
from usdbrdf.geometry.rays import Hits, RayScene
from usdbrdf.geometry.surface_radiance import surface_texture
from usdbrdf.job.progress import progress
from usdbrdf.scan.scan import Frames
from usdbrdf.steps.preview import camera_hits

Float = npt.NDArray[np.float32]
Byte = npt.NDArray[np.uint8]

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
