"""An asset as it lies on disk, and what a camera would see of it by the paper's image model (eq. 1,
2) and by its baseline.

baseline   I = L_d                          the lit texture, the same from everywhere
full       I = diffuse + I_nd(phi, psi)     one specular bounce of the lit texture
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from usdbrdf.asset.header import read_header
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Bool, Double, Float
from usdbrdf.model.camera import Camera
from usdbrdf.transport.environment import environment_from_file
from usdbrdf.transport.lit_scene import LitScene, SurfacePoints, visible_points
from usdbrdf.transport.lobe_radiance import lobe_radiance
from usdbrdf.transport.surface_texture import SurfaceTexture

# Surface points of a picture at once: what bounds the memory.
_POINTS_AT_ONCE = 1 << 20


@dataclass(frozen=True, kw_only=True)
class ViewedAsset:
    """What is seen: the scene with its light; L_d, and L_d without specular light, on the surface;
    the lobe of each object, (num_objects,), NaN for none."""

    lit: LitScene
    measured: SurfaceTexture
    diffuse: SurfaceTexture
    phi: Float
    psi: Float


@dataclass(frozen=True, kw_only=True)
class PredictedView:
    """baseline, full (H, W, 3) radiance, pixels averaged over their sub-pixels; surface (H, W):
    all of the pixel shows the asset; lamp (H, W): some of it shows an emitter."""

    baseline: Float
    full: Float
    surface: Bool
    lamp: Bool


class Quality(NamedTuple):
    """How carefully views are predicted: points along each side of a pixel, which is their mean;
    rays per pixel for I_nd, shared among its points; seed of the random numbers."""

    per_side: int
    rays: int
    seed: int


def measured_atlas(folder: Path) -> tuple[Asset, AssetMaps]:
    """The maps of an asset that all steps have been through, without the artist's layer."""
    asset = Asset.made(folder)
    return asset, AssetMaps(open_measured(asset))


def map_or(atlas: AssetMaps, aov: str, otherwise: str) -> str:
    """The name of the first map where the asset has it, else of the second."""
    return aov if atlas.has(aov) else otherwise


def viewed_asset(asset: Asset, atlas: AssetMaps, environment: Path | None) -> ViewedAsset:
    """Its light, its diffuse radiance (``diffuse``, else ``lit``), its lobes as the fit left them.

    environment  latitude-longitude picture of the surroundings, None: black
    """
    fits = [read_fit(atlas.stage, obj.prim_path) for obj in atlas.scene.objects]
    if any(fit is None for fit in fits):
        raise InputRefused(
            f"{asset.folder}: its objects have no roughness and specular yet. Run `usdbrdf fit` "
            "first. [asset.incomplete]"
        )
    up_axis = read_header(asset.layer("scan")).up_axis
    lit = atlas.lit_scene(environment_from_file(environment, up_axis))
    diffuse = atlas.map_where_present(map_or(atlas, "diffuse", "lit"), 3)
    return ViewedAsset(
        lit=lit,
        measured=lit.radiance.showing(atlas.texels, atlas.map("lit")),
        diffuse=lit.radiance.showing(atlas.texels, diffuse),
        phi=np.array([fit.phi for fit in fits if fit], np.float32),
        psi=np.array([fit.psi for fit in fits if fit], np.float32),
    )


def predict_view(seen: ViewedAsset, camera: Camera, quality: Quality) -> PredictedView:
    """One picture by both models, box-filtered over ``per_side``^2 points per pixel."""
    per_pixel = quality.per_side**2
    width, height = camera.width, camera.height
    rows = max(1, _POINTS_AT_ONCE // (width * per_pixel))
    bands = []
    for top in range(0, height, rows):
        pixels = _sub_pixels(width, top, min(top + rows, height), quality.per_side)
        points = visible_points(seen.lit, camera, pixels)
        values = _radiance_at(seen, points, max(1, quality.rays // per_pixel), quality.seed + top)
        bands.append(values.reshape(-1, width, per_pixel, values.shape[1]).mean(axis=2))
    picture = np.concatenate(bands).astype(np.float32)
    return PredictedView(
        baseline=picture[..., :3],
        full=picture[..., 3:6],
        surface=picture[..., 6] > 1 - 0.5 / per_pixel,
        lamp=picture[..., 7] > 0,
    )


def _sub_pixels(width: int, top: int, bottom: int, per_side: int) -> Double:
    """(R, 2) points of rows top to bottom, pixel by pixel, ``per_side``^2 in each."""
    offset = (np.arange(per_side) + 0.5) / per_side
    rows, columns, down, right = np.meshgrid(
        np.arange(top, bottom), np.arange(width), offset, offset, indexing="ij"
    )
    return np.stack([columns + right, rows + down], axis=-1).reshape(-1, 2)


def _radiance_at(seen: ViewedAsset, points: SurfacePoints, rays: int, seed: int) -> Float:
    """(R, 8): baseline, full, 1 on the surface, 1 on an emitter."""
    hit = points.face >= 0
    place = points.face, points.u, points.v
    lamp = hit & seen.lit.emits(points)
    values = np.zeros((len(hit), 8), np.float32)
    values[:, :3] = seen.measured.at(*place)
    values[:, 3:6] = np.where(lamp[:, None], values[:, :3], seen.diffuse.at(*place))
    values[:, 6], values[:, 7] = hit, lamp
    owner = seen.lit.owner(points.face)
    known = np.isfinite(seen.phi) & np.isfinite(seen.psi)
    reflects = np.flatnonzero(hit & ~lamp & known[owner])
    owner = owner[reflects]
    values[reflects, 3:6] += lobe_radiance(
        seen.lit, points.take(reflects), seen.phi[owner], seen.psi[owner], rays, seed
    )
    return values
