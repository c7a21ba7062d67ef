"""How far an asset is from a capture's known truth.

    python benchmarks/accuracy.py ASSET TRUTH_FOLDER MESH_PLY [--json FILE]

TRUTH_FOLDER holds objects.json (phi, psi, emission per object) and albedo_vertex.npz (albedo per
vertex of MESH_PLY), as `samples/study/truth` does. Printed are, over texels seen at least three
times on objects that do not emit, inside a triangle, weighted by area:

    L_d      median |relative error| against the exact per-texel median of the same samples
    S        relative RMSE and median bias against our own S with 4096 rays per texel
    albedo   NRMSE, ||x - truth|| / ||truth||, and the median relative error
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
import trimesh
from scipy.spatial import cKDTree

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.geometry.rays import RayScene
from usdbrdf.geometry.surface_radiance import surface_texture
from usdbrdf.scan.frame_reading import read_frame
from usdbrdf.shading.environment import black_environment
from usdbrdf.shading.irradiance import Sampling, irradiance_at, patches_of_texels
from usdbrdf.shading.lights import lights_from_radiance
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.read import frames_from_stage, open_measured, read_fit, read_shading
from usdbrdf.steps.atlas import Atlas, atlas_from_stage
from usdbrdf.texturing.samples_from_frame import SAMPLE, first_surfaces, samples_from_frame

MIN_SAMPLES = 3
REFERENCE_RAYS = 4096


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--share", type=int, default=24, help="every n-th patch for L_d and S")
    options = parser.parse_args()

    stage = open_measured(Asset.at(options.asset))
    atlas = atlas_from_stage(stage)
    truth = {o["name"]: o for o in json.loads((options.truth / "objects.json").read_text())}
    shines = np.array([max(truth[o.label]["emission"]) > 0 for o in atlas.scene.objects])
    owner = atlas.texels.object_index()
    scored = (atlas.map("samples")[:, 0] >= MIN_SAMPLES) & ~shines[owner] & atlas.texels.interior
    results = {
        "texels": len(atlas.texels),
        "scored_texels": int(scored.sum()),
        "L_d": diffuse_error(atlas, scored, options.share),
        "S": irradiance_error(atlas, scored, options.share),
        "albedo": albedo_error(atlas, scored, options.truth, options.mesh),
        "emitters": emitter_error(atlas, shines, owner),
        "material": material_error(atlas, truth, shines),
    }
    text = json.dumps(results, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")
    return 0


def some_patches(atlas: Atlas, share: int) -> tuple[np.ndarray, np.ndarray]:
    """Texels of every ``share``-th patch, and their patch numbers."""
    order, patch = patches_of_texels(atlas.texels)
    keep = patch % share == 0
    return order[keep], patch[keep]


def diffuse_error(atlas: Atlas, scored: np.ndarray, share: int) -> dict[str, float]:
    """L_d against the exact median of the samples that the streaming median saw."""
    frames = frames_from_stage(atlas.stage)
    scene, texels = atlas.scene, atlas.texels
    rays = RayScene(scene.points, scene.triangles)
    chosen, _ = some_patches(atlas, share)
    chosen = chosen[scored[chosen]]
    place = np.full(len(texels), -1)
    place[chosen] = np.arange(len(chosen))
    store: list[list[np.ndarray]] = [[] for _ in chosen]
    for i in range(len(frames)):
        pixels = read_frame(frames, i)
        pose, lens = frames.world_from_camera[i], frames.intrinsics[i]
        surfaces = first_surfaces(rays, scene.face_object, pose, lens, frames.resolution[i])
        kind, radiance = samples_from_frame(
            texels, texels.object_index(), surfaces, np.nan_to_num(pixels.radiance), pixels.valid,
            pixels.clipped, pose, lens,
        )  # fmt: skip
        for t in np.flatnonzero((kind == SAMPLE) & (place >= 0)):
            store[place[t]].append(radiance[t])
    exact = np.array([np.median(samples, axis=0) for samples in store])
    relative = atlas.map("lit")[chosen] / np.maximum(exact, 1e-9) - 1
    return {
        "median_abs_relative": float(np.median(np.abs(relative))),
        "median_signed": float(np.median(relative)),
    }


def irradiance_error(atlas: Atlas, scored: np.ndarray, share: int) -> dict[str, float]:
    """S against a converged S from the same L_d."""
    scene, texels = atlas.scene, atlas.texels
    lit = atlas.map("lit")
    order, patch = some_patches(atlas, share)
    reference = irradiance_at(
        RayScene(scene.points, scene.triangles),
        surface_texture(texels, scene.face_object, lit),
        lights_from_radiance(scene, texels, lit),
        black_environment(),
        texels.position[order],
        texels.normal[order],
        patch,
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


def albedo_error(atlas: Atlas, scored: np.ndarray, folder: Path, mesh: Path) -> dict[str, Any]:
    """Albedo against the truth, linear between the vertices of the capture's mesh."""
    known = true_albedo(atlas, folder, mesh)[scored]
    found = atlas.map("albedo")[scored]
    area = atlas.texels.area[scored]
    owner = atlas.texels.object_index()[scored]

    def nrmse(part: np.ndarray) -> float:
        w = area[part, None]
        return float(
            np.sqrt((w * (found[part] - known[part]) ** 2).sum() / (w * known[part] ** 2).sum())
        )

    relative = found / np.maximum(known, 1e-6) - 1
    return {
        "nrmse": nrmse(np.ones(len(found), bool)),
        "median_abs_relative": float(np.median(np.abs(relative))),
        "median_signed": float(np.median(relative)),
        "objects": {
            obj.identifier: round(nrmse(owner == i), 4)
            for i, obj in enumerate(atlas.scene.objects)
            if (owner == i).any()
        },
    }


def true_albedo(atlas: Atlas, folder: Path, mesh: Path) -> np.ndarray:
    """(T, 3): each face of ours is found in the truth's mesh by its centre."""
    with np.load(folder / "albedo_vertex.npz", allow_pickle=False) as file:
        per_vertex = file["albedo"]
    source = trimesh.load(mesh, process=False)
    corners = np.asarray(source.vertices, np.float32)[source.faces]
    labels = np.asarray(source.metadata["_ply_raw"]["face"]["data"]["object_id"]).ravel()
    names = {
        o["id"]: o["name"]
        for o in json.loads((mesh.parent / "objects.json").read_text())["objects"]
    }
    result = np.zeros((len(atlas.texels), 3))
    for i, obj in enumerate(atlas.scene.objects):
        own = atlas.texels.of_object(i)
        theirs = np.flatnonzero([names[int(label)] == obj.label for label in labels])
        face = atlas.texels.face[own]
        ours = atlas.scene.points[atlas.scene.triangles[face]]
        _, nearest = cKDTree(corners[theirs].mean(axis=1)).query(ours.mean(axis=1))
        match = theirs[nearest]
        distance = np.linalg.norm(ours[:, :, None] - corners[match][:, None], axis=-1)
        corner = distance.argmin(axis=2)
        values = per_vertex[source.faces[match[:, None], corner]]
        result[own] = np.einsum("tc,tcd->td", atlas.texels.barycentric[own], values)
    return result


def emitter_error(atlas: Atlas, shines: np.ndarray, owner: np.ndarray) -> dict[str, Any]:
    emissive = (atlas.map_where_present("emission", 3) > 0).any(axis=1)
    found = [read_shading(atlas.stage, o.prim_path) for o in atlas.scene.objects]
    lamps = np.array([bool(record and record.emitter) for record in found])
    return {
        "lamps_found": int((lamps & shines).sum()),
        "lamps_missed": int((~lamps & shines).sum()),
        "false_lamps": int((lamps & ~shines).sum()),
        "false_positive_texels": float(emissive[~shines[owner]].mean()),
    }


def material_error(atlas: Atlas, truth: dict[str, Any], shines: np.ndarray) -> dict[str, Any]:
    rows = {}
    for obj, emits in zip(atlas.scene.objects, shines, strict=True):
        fit = read_fit(atlas.stage, obj.prim_path)
        if emits or fit is None:
            continue
        known = truth[obj.label]
        rows[obj.identifier] = {
            "truth": [known["phi"], known["psi"]],
            "found": [round(fit.phi, 3), round(fit.psi, 3)],
            "status": fit.status,
            "evidence": round(fit.evidence, 3),
            "error": [round(abs(fit.phi - known["phi"]), 3), round(abs(fit.psi - known["psi"]), 3)],
        }

    def mean(status: str | None, k: int) -> float:
        errors = [r["error"][k] for r in rows.values() if status in (None, r["status"])]
        return float(np.mean(errors)) if errors else float("nan")

    return {
        "objects": len(rows),
        "mean_abs_phi": mean(None, 0),
        "mean_abs_psi": mean(None, 1),
        "measured": sum(r["status"] == "measured" for r in rows.values()),
        "measured_mean_abs_phi": mean("measured", 0),
        "measured_mean_abs_psi": mean("measured", 1),
        "rows": rows,
    }


if __name__ == "__main__":
    sys.exit(main())
