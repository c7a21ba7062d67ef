"""How far an asset's maps are from the true light of a rendered capture.

    python benchmarks/against_reference.py ASSET REFERENCE.npz

REFERENCE.npz comes from `path_traced_irradiance.py` and holds the true irradiance E and albedo at
points of the surface. At those whose texels were all seen at least three times, lie inside a
triangle and are not emissive, on objects that do not emit, the maps are read bilinearly and
compared:

    irradiance, refined_irradiance   with E
    lit, diffuse                     with albedo / pi * E
    albedo, base_color               with albedo

Printed as JSON, for all points, those within 4.5 cm of another object (`contacts`), the `rest`, and
each object: median error and median absolute error, relative, of all channels' values (as
`accuracy.py` takes them), of the channels' mean and of each channel, the error of the sums over all
points, and NRMSE = ||x - truth|| / ||truth||. All are weighted by the area the points stand for.
`reference_error` is the mean relative standard error of E there: as noise it raises the absolute
errors and the NRMSE, and as it is skewed the medians of the signed ones, but not the sums'. What
the capture's own frames lack tells `frames_against_reference.py`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import aov_path
from usdbrdf.files.documents import load_arrays
from usdbrdf.transport.rays import RayScene
from usdbrdf.transport.surface_texture import SurfaceTexture, surface_texture

MIN_SAMPLES = 3
CONTACT = 0.045  # m
LIFT = 1e-3  # m; a point is looked up along a ray from just above it
MAX_DISTANCE = 2e-3  # m between a point and our surface

Array = np.ndarray


class Places(NamedTuple):
    """Where the points (R,) lie on the asset: row in the reference, face and barycentrics."""

    row: Array
    face: Array
    u: Array
    v: Array

    def values(self, texture: SurfaceTexture) -> Array:
        return texture.at(self.face, self.u, self.v).astype(np.float64)

    def take(self, index: Array) -> Places:
        return Places(*(column[index] for column in self))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("reference", type=Path)
    options = parser.parse_args()

    atlas = AssetMaps(open_measured(Asset.at(options.asset)))
    reference = load_arrays(options.reference)
    places = well_seen(atlas, places_on_asset(atlas, reference))
    if not len(places.row):
        raise SystemExit(f"{options.reference}: no point lies on a well-seen texel of the asset")
    found, truth = compared_maps(atlas, reference, places)
    owner = atlas.scene.face_object[places.face]
    contact = near_others(atlas, reference["position"][places.row], owner)
    parts = {"all": np.full(len(owner), True), "contacts": contact, "rest": ~contact}
    own = {atlas.scene.objects[i].label: owner == i for i in np.unique(owner)}

    def scored(part: Array) -> dict[str, Any]:
        return scores(reference, places.row, found, truth, part)

    results: dict[str, Any] = {"reference_points": len(reference["E"])}
    results |= {name: scored(part) for name, part in parts.items() if part.any()}
    results["objects"] = {name: scored(part) for name, part in own.items()}
    print(json.dumps(results, indent=2))
    return 0


# ---- where the points are ----------------------------------------------------------------------


def places_on_asset(atlas: AssetMaps, reference: dict[str, Array]) -> Places:
    """The points that lie on our surface of the same object."""
    scene = atlas.scene
    normal = reference["normal"].astype(np.float32)
    origin = np.ascontiguousarray(reference["position"] + np.float32(LIFT) * normal, np.float32)
    hits = RayScene(scene.points, scene.triangles).closest(origin, -normal)
    labels = np.array([obj.label for obj in scene.objects])
    same = labels[scene.face_object[hits.face]] == reference["names"][reference["object"]]
    met = (hits.face >= 0) & same & (np.abs(hits.distance - LIFT) < MAX_DISTANCE)
    row = np.flatnonzero(met)
    return Places(row, hits.face[row], hits.u[row], hits.v[row])


def well_seen(atlas: AssetMaps, places: Places) -> Places:
    """The places all of whose texels are seen often enough, inside a triangle and not emissive."""
    dark = ~(atlas.map_where_present("emission", 3) > 0).any(axis=1)
    usable = (atlas.map("samples")[:, 0] >= MIN_SAMPLES) & atlas.texels.interior & dark
    values = np.repeat(usable[:, None], 3, axis=1).astype(np.float32)
    share = places.values(surface_texture(atlas.texels, atlas.scene.face_object, values))[:, 0]
    return places.take(share > 0.999)


def near_others(atlas: AssetMaps, position: Array, owner: Array) -> Array:
    """(R,) bool: within CONTACT of a texel of another object."""
    near = np.zeros(len(position), bool)
    for i in range(len(atlas.scene.objects)):
        other = np.flatnonzero((owner != i) & ~near)
        texels = atlas.texels.position[atlas.texels.of_object(i)]
        if len(other) and len(texels):
            distance, _ = cKDTree(texels).query(position[other], distance_upper_bound=CONTACT)
            near[other] = np.isfinite(distance)
    return near


# ---- what the maps say there -------------------------------------------------------------------


def compared_maps(
    atlas: AssetMaps, reference: dict[str, Array], places: Places
) -> tuple[dict[str, Array], dict[str, Array]]:
    """The asset's maps and their truth at the places, (R, 3) each, by name."""
    light = reference["E"][places.row].astype(np.float64)
    albedo = reference["albedo"][places.row].astype(np.float64)
    truth = {"irradiance": light, "lit": albedo / np.pi * light, "albedo": albedo}
    truth |= {"refined_irradiance": light, "diffuse": truth["lit"], "base_color": albedo}
    truth = {name: truth[name] for name in truth if everywhere(atlas, name)}
    found = {
        name: places.values(surface_texture(atlas.texels, atlas.scene.face_object, atlas.map(name)))
        for name in truth
    }
    return found, truth


def everywhere(atlas: AssetMaps, aov: str) -> bool:
    """Whether every object of the asset has the map."""
    return all(aov_path(atlas.stage, obj.prim_path, aov) is not None for obj in atlas.scene.objects)


def scores(
    reference: dict[str, Array],
    rows: Array,
    found: dict[str, Array],
    truth: dict[str, Array],
    part: Array,
) -> dict[str, Any]:
    area = reference["area"][rows[part]].astype(np.float64)
    light, error = (reference[key][rows[part]] for key in ("E", "standard_error"))
    relative = (error / np.maximum(light, 1e-9)).mean(axis=1)
    result: dict[str, Any] = {
        "points": int(part.sum()),
        "reference_error": round(float(np.average(relative, weights=area)), 5),
    }
    for name, values in found.items():
        result[name] = errors(values[part], truth[name][part], area)
    return result


def errors(found: Array, truth: Array, area: Array) -> dict[str, Any]:
    """Relative errors of values (R, 3), weighted by ``area`` (R,)."""
    channels = found / np.maximum(truth, 1e-9) - 1
    mean = found.mean(axis=1) / np.maximum(truth.mean(axis=1), 1e-9) - 1
    whole = np.maximum((area[:, None] * truth).sum(axis=0), 1e-9)
    sums = (area[:, None] * found).sum(axis=0) / whole - 1
    squares = (area[:, None] * (found - truth) ** 2).sum() / (area[:, None] * truth**2).sum()
    every, each = channels.ravel(), np.repeat(area, 3)
    return {
        "signed": round(weighted_median(every, each), 5),
        "absolute": round(weighted_median(np.abs(every), each), 5),
        "signed_mean": round(weighted_median(mean, area), 5),
        "absolute_mean": round(weighted_median(np.abs(mean), area), 5),
        "signed_rgb": [round(weighted_median(c, area), 5) for c in channels.T],
        "absolute_rgb": [round(weighted_median(np.abs(c), area), 5) for c in channels.T],
        "sums_rgb": [round(float(c), 5) for c in sums],
        "nrmse": round(float(np.sqrt(squares)), 5),
    }


def weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    below = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(below, below[-1] / 2)]])


if __name__ == "__main__":
    sys.exit(main())
