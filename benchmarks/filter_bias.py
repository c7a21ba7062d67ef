"""What the lightmap filter changes in an asset's irradiance, and whether it is nearer to the truth.

    python benchmarks/filter_bias.py ASSET [--json FILE] [--share 24]

ASSET was shaded with `--denoise oidn`, without `--environment`: it has S as traced
(`irradiance_raw`) and filtered (`irradiance`). On texels seen at least three times, inside a
triangle and not emissive, both weighted by area, printed are

    filtered_to_raw  relative change of the mean S, mean and median of the texels' relative changes;
                     of all texels, those within 4.5 cm of another object (`contacts`), the rest,
                     and the change of the mean S of each object
    against_4096_rays
                     on every n-th tile, of S raw and filtered against our own S with 4096 rays per
                     texel: mean and median relative error, relative RMSE; `darkest` are the tenth
                     of the contacts with the least light, the deepest shadows
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from against_reference import MIN_SAMPLES, Array, near_others, weighted_median

import usdbrdf  # noqa: F401  (registers the schemas)
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.options import Sampling
from usdbrdf.transport.environment import black_environment
from usdbrdf.transport.irradiance import irradiance_at, tiles_of_texels

REFERENCE = Sampling(standard_error=0.0, max_rays=4096, seed=977)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("asset", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--share", type=int, default=24, help="every n-th tile for the reference")
    options = parser.parse_args()

    atlas = AssetMaps(open_measured(Asset.at(options.asset)))
    if not atlas.has("irradiance_raw"):
        raise SystemExit(f"{options.asset}: not filtered. Run `usdbrdf shade --denoise oidn`")
    raw, filtered = (atlas.map(name).mean(axis=1) for name in ("irradiance_raw", "irradiance"))
    emissive = (atlas.map_where_present("emission", 3) > 0).any(axis=1)
    seen = atlas.map("samples")[:, 0] >= MIN_SAMPLES
    scored = seen & atlas.texels.interior & ~emissive & (raw > 0)
    contact = near_others(atlas, atlas.texels.position, atlas.texels.object_index())
    results = {
        "texels": int(scored.sum()),
        "contact_share": float(contact[scored].mean()),
        "filtered_to_raw": changes(atlas, raw, filtered, scored, contact),
        "against_4096_rays": errors(atlas, raw, filtered, scored, contact, options.share),
    }
    text = json.dumps(results, indent=2)
    print(text)
    if options.json:
        options.json.write_text(text + "\n")
    return 0


def changes(
    atlas: AssetMaps, raw: Array, filtered: Array, scored: Array, contact: Array
) -> dict[str, Any]:
    """Relative changes of S (T,) by the filter."""
    area, owner = atlas.texels.area.astype(np.float64), atlas.texels.object_index()

    def of_mean(part: Array) -> float:
        before, after = (np.average(values[part], weights=area[part]) for values in (raw, filtered))
        return round(float(after / before - 1), 6)

    def of_texels(part: Array) -> dict[str, float]:
        relative = filtered[part] / raw[part] - 1
        return {
            "change_of_mean": of_mean(part),
            "mean": round(float(np.average(relative, weights=area[part])), 6),
            "median": round(weighted_median(relative, area[part]), 6),
        }

    parts = {"all": scored, "contacts": scored & contact, "rest": scored & ~contact}
    objects = {
        obj.identifier: of_mean(scored & (owner == i))
        for i, obj in enumerate(atlas.scene.objects)
        if (scored & (owner == i)).any()
    }
    return {**{name: of_texels(part) for name, part in parts.items()}, "objects": objects}


def errors(
    atlas: AssetMaps, raw: Array, filtered: Array, scored: Array, contact: Array, share: int
) -> dict[str, Any]:
    """Relative errors of S raw and filtered against a converged S of the same light."""
    order, tile = tiles_of_texels(atlas.texels)
    keep = tile % share == 0
    order, tile = order[keep], tile[keep]
    position, normal = atlas.texels.position[order], atlas.texels.normal[order]
    lit = atlas.lit_scene(black_environment())
    reference = irradiance_at(
        lit.rays, lit.radiance, lit.lights, lit.environment, position, normal, tile, REFERENCE,
        lit.diagonal_m,
    ).mean.mean(axis=1)  # fmt: skip
    near = contact[order]
    good = scored[order] & (reference > 0)
    dark = near & (reference <= np.quantile(reference[good & near], 0.1))
    parts = {"all": good, "contacts": good & near, "darkest": good & dark, "rest": good & ~near}
    area = atlas.texels.area[order].astype(np.float64)

    def against(values: Array, part: Array) -> dict[str, float]:
        relative, weights = values[order[part]] / reference[part] - 1, area[part]
        return {
            "mean": round(float(np.average(relative, weights=weights)), 6),
            "median": round(weighted_median(relative, weights), 6),
            "rmse": round(float(np.sqrt(np.average(relative**2, weights=weights))), 6),
        }

    return {
        name: {"texels": int(p.sum()), "raw": against(raw, p), "filtered": against(filtered, p)}
        for name, p in parts.items()
    }


if __name__ == "__main__":
    sys.exit(main())
