"""How Cycles shows an asset, against known pictures of the room.

    USDBRDF_BPY_PYTHON=... python benchmarks/cycles_views.py ASSET VIEWS.json [--samples 64]
                                                              [--mapping measured matched] [--out F]

Blender, in a process of its own, imports the stage as it lies on disk and renders it by its own
recovered emitters from the cameras of VIEWS.json, whose pictures are the reference. With --mapping
the materials are first written again in a layer of their own, once for each mapping, from phi and
psi of the stage. Printed as JSON: mean FLIP over the views at one exposure for all of them (the
90th percentile of their mean radiance is shown as 0.8), relative L2 without what is shown white,
median of (picture / reference - 1), and seconds. Needs an asset in metres with z up.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from blender import in_blender
from pxr import Sdf, Usd, UsdGeom

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.header import Scopes
from usdbrdf.asset.layers.looks import lobe, scale_texture
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.preview_lobe import preview_surface_from_fit
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.asset.readers.views import Views, photographs_of_views
from usdbrdf.evaluation.evaluate_views import exposure_of_views, measured_atlas
from usdbrdf.evaluation.metrics import Pair, flip_maps, relative_l2
from usdbrdf.files.colour import to_display_srgb
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import read_radiance

AS_WRITTEN = "as written"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("views", type=Path)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--denoise", action="store_true", help="with Blender's own denoiser")
    parser.add_argument("--first", type=int, help="only the first N views")
    parser.add_argument("--mapping", nargs="+", default=[AS_WRITTEN])
    parser.add_argument("--out", type=Path, help="keep the pictures in this folder")
    chosen = parser.parse_args()
    asset, atlas = measured_atlas(chosen.asset)
    views = photographs_of_views(chosen.views, asset, atlas.stage, atlas.scene, Path())
    count = min(len(views.frames), chosen.first or len(views.frames))
    exposure = exposure_of_views(views.frames)
    found = {}
    with tempfile.TemporaryDirectory() as temporary:
        for mapping in chosen.mapping:
            folder = (chosen.out or Path(temporary)) / mapping.replace(" ", "_")
            folder.mkdir(parents=True, exist_ok=True)
            layer = asset.root_layer
            if mapping != AS_WRITTEN:
                layer = with_mapping(asset, atlas, mapping, folder / "materials.usda")
            start = time.perf_counter()
            render(layer, views, count, (chosen.samples, chosen.denoise), folder)
            seconds = time.perf_counter() - start
            found[mapping] = figures(folder, views, count, exposure) | {"seconds": round(seconds)}
    print(json.dumps(found, indent=2))


def with_mapping(asset: Asset, atlas: AssetMaps, mapping: str, path: Path) -> Path:
    """A layer over the asset that tells its materials phi and psi by this mapping."""
    layer = Sdf.Layer.CreateNew(str(path))
    layer.subLayerPaths = [str(asset.root_layer.absolute())]
    layer.defaultPrim = asset.name
    UsdGeom.SetStageMetersPerUnit(Usd.Stage.Open(layer), 1.0)
    UsdGeom.SetStageUpAxis(Usd.Stage.Open(layer), "Z")
    for obj in atlas.scene.objects:
        fit = read_fit(atlas.stage, obj.prim_path)
        if fit is None or not math.isfinite(fit.phi) or not math.isfinite(fit.psi):
            continue
        material = Scopes.of(asset).material(obj.identifier)
        shown = preview_surface_from_fit(fit.phi, fit.psi, mapping)
        lobe(layer, material, shown.roughness, shown.ior)
        for texture in ("AlbedoTexture", "BaseColorTexture"):
            if atlas.stage.GetPrimAtPath(f"{material}/{texture}"):
                scale_texture(layer, material, texture, shown.diffuse)
    layer.Save()
    return path


def render(layer: Path, views: Views, count: int, quality: tuple[int, bool], out: Path) -> None:
    frames = views.frames
    job = {
        "layer": str(layer),
        "samples": quality[0],
        "denoise": quality[1],
        "surroundings": 0.0,
        "out": str(out.absolute()),
        "views": [
            {
                "world_from_camera": frames.world_from_camera[i].tolist(),
                "intrinsics": frames.intrinsics[i].tolist(),
                "resolution": frames.resolution[i].tolist(),
            }
            for i in range(count)
        ],
    }
    in_blender("blender_views", out, job)


def figures(folder: Path, views: Views, count: int, exposure: float) -> dict[str, Any]:
    pairs, l2, ratios = [], [], []
    for i in range(count):
        reference = read_frame(views.frames, i).radiance
        picture = read_radiance(folder / f"view_{i:02d}.exr")[..., :3]
        known = np.isfinite(reference).all(axis=2) & (reference * exposure < 1).all(axis=2)
        l2.append(relative_l2(picture, reference, known))
        ratios.append((picture.mean(axis=2) / np.maximum(reference.mean(axis=2), 1e-6))[known])
        pairs.append(Pair(*(shown(p, exposure) for p in (np.nan_to_num(reference), picture))))
    flips = [round(float(m.mean()), 4) for m in flip_maps(pairs, "rendered views")]
    return {
        "flip": round(float(np.mean(flips)), 4),
        "flip_per_view": flips,
        "relative_l2": round(float(np.mean(l2)), 4),
        "median_bias": round(float(np.median(np.concatenate(ratios))) - 1, 4),
    }


def shown(radiance: np.ndarray, exposure: float) -> np.ndarray:
    return np.clip(to_display_srgb(radiance, exposure_scale=exposure), 0, 1).astype(np.float32)


if __name__ == "__main__":
    main()
