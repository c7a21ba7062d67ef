"""How far an asset is from a capture's known truth.

    python benchmarks/accuracy.py ASSET TRUTH_FOLDER MESH_PLY [--json FILE]

TRUTH_FOLDER holds objects.json (phi, psi, emission per object) and albedo_vertex.npz (albedo per
vertex of MESH_PLY), as `samples/study/truth` does. Printed are, over texels seen at least three
times on objects that do not emit, inside a triangle, weighted by area:

    L_d      median |relative error| against the exact per-texel median of the same samples
    S        relative RMSE and median bias against our own S with 4096 rays per texel
    albedo   NRMSE, ||x - truth|| / ||truth||, and the median relative error; the same of base_color
    emitters lamps found and missed; share of the other texels called emissive
    phi, psi mean absolute error over the objects that do not emit
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import frames_from_stage, read_shading
from usdbrdf.evaluation.metrics import (
    albedo_error,
    emitters,
    known_objects,
    material_error,
    scored_texels,
    true_albedo,
)
from usdbrdf.files.frames import read_frame
from usdbrdf.options import Sampling
from usdbrdf.texturing.samples import SAMPLE, Picture, first_surfaces, samples_from_frame
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels
from usdbrdf.transport.lights import lights_from_radiance
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import surface_texture

REFERENCE_RAYS = 4096


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--share", type=int, default=24, help="every n-th tile for L_d and S")
    options = parser.parse_args()

    stage = open_measured(Asset.at(options.asset))
    atlas = AssetMaps(stage)
    truth = known_objects(options.truth, atlas)
    shines = emitters(atlas, truth)
    owner = atlas.texels.object_index()
    scored = scored_texels(atlas, shines)
    albedo = true_albedo(atlas, options.truth, options.mesh)
    results = {
        "texels": len(atlas.texels),
        "scored_texels": int(scored.sum()),
        "L_d": diffuse_error(atlas, scored, options.share),
        "S": irradiance_error(atlas, scored, options.share),
        **{
            name: albedo_error(atlas, scored, atlas.map_where_present(name, 3), albedo)
            for name in ("albedo", "base_color")
            if atlas.has(name)
        },
        "emitters": emitter_error(atlas, shines, owner),
        "material": material_error(atlas, truth, shines),
    }
    text = json.dumps(results, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")
    return 0


def some_tiles(atlas: AssetMaps, share: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels of every ``share``-th tile, and their tile numbers."""
    order, tile = tiles_of_texels(atlas.texels)
    keep = tile % share == 0
    return order[keep], tile[keep]


def diffuse_error(atlas: AssetMaps, scored: np.ndarray, share: int) -> dict[str, float]:
    """L_d against the exact median of the samples that the streaming median saw."""
    frames = frames_from_stage(atlas.stage)
    scene, texels = atlas.scene, atlas.texels
    rays = RayScene(scene.points, scene.triangles)
    chosen, _ = some_tiles(atlas, share)
    chosen = chosen[scored[chosen]]
    place = np.full(len(texels), -1)
    place[chosen] = np.arange(len(chosen))
    store: list[list[np.ndarray]] = [[] for _ in chosen]
    for i in range(len(frames)):
        pixels = read_frame(frames, i)
        surfaces = first_surfaces(rays, scene.face_object, frames.camera(i))
        picture = Picture(np.nan_to_num(pixels.radiance), pixels.valid, pixels.clipped, pixels.dark)
        kind, radiance = samples_from_frame(
            texels, texels.object_index(), surfaces, picture, frames.camera(i)
        )
        for t in np.flatnonzero((kind == SAMPLE) & (place >= 0)):
            store[place[t]].append(radiance[t])
    seen = np.array([len(samples) > 0 for samples in store])
    exact = np.array([np.median(samples, axis=0) for samples in store if samples])
    relative = atlas.map("lit")[chosen[seen]] / np.maximum(exact, 1e-9) - 1
    return {
        "median_abs_relative": float(np.median(np.abs(relative))),
        "median_signed": float(np.median(relative)),
    }


def irradiance_error(atlas: AssetMaps, scored: np.ndarray, share: int) -> dict[str, float]:
    """S against a converged S from the same L_d."""
    scene, texels = atlas.scene, atlas.texels
    lit = atlas.light
    order, tile = some_tiles(atlas, share)
    reference = irradiance_at(
        RayScene(scene.points, scene.triangles),
        surface_texture(texels, scene.face_object, lit),
        lights_from_radiance(scene, texels, lit),
        black_environment(),
        texels.position[order],
        texels.normal[order],
        tile,
        Sampling(standard_error=0.0, max_rays=REFERENCE_RAYS, seed=977),
        float(np.linalg.norm(np.ptp(scene.points, axis=0))),
    ).mean.mean(axis=1)
    ours = atlas.map("irradiance")[order].mean(axis=1)
    good = scored[order]
    relative = ours[good] / reference[good] - 1
    return {
        "relative_rmse": float(np.sqrt((relative**2).mean())),
        "median_bias": float(np.median(relative)),
    }


def emitter_error(atlas: AssetMaps, shines: np.ndarray, owner: np.ndarray) -> dict[str, Any]:
    emissive = (atlas.map_where_present("emission", 3) > 0).any(axis=1)
    found = [read_shading(atlas.stage, o.prim_path) for o in atlas.scene.objects]
    lamps = np.array([bool(record and record.emitter) for record in found])
    return {
        "lamps_found": int((lamps & shines).sum()),
        "lamps_missed": int((~lamps & shines).sum()),
        "false_lamps": int((lamps & ~shines).sum()),
        "false_positive_texels": float(emissive[~shines[owner]].mean()),
    }


if __name__ == "__main__":
    sys.exit(main())
