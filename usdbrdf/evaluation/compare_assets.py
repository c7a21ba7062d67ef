"""Two assets of one scene under different light: do their albedos agree, do they predict each
other? (paper, section 4.2, Fig. 5 and 6)"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.frames import frames_from_stage
from usdbrdf.errors import InputRefused
from usdbrdf.evaluation.relit import MapNames, Relit, errors, matched, relit, write_pictures
from usdbrdf.evaluation.report import FILES, files_of, output_folder, table_text
from usdbrdf.evaluation.viewed_asset import measured_atlas
from usdbrdf.files.atomic import write_text_atomic
from usdbrdf.files.documents import write_json
from usdbrdf.job.progress import say

DOCUMENT = "comparison.json"

# As textured, and after the specular light was taken out of it.
_SETS = {
    "lit": MapNames(radiance="lit", irradiance="irradiance", albedo="albedo"),
    "diffuse": MapNames(radiance="diffuse", irradiance="refined_irradiance", albedo="base_color"),
}


def compare(first: str | Path, second: str | Path, output: str | Path) -> dict[str, Any]:
    """Compare two assets of the same geometry and write figures and pictures to ``output``.

    first, second  asset folders, A and B; only read. Their texels need not be the same
    output         folder for comparison.json, comparison.csv (per object) and pictures/
    returns        the content of comparison.json: per set of maps (``lit``: L_d and albedo;
                   ``diffuse``: without specular light, where both assets have it) NRMSE and median
                   relative errors of ``albedo`` (B against A), ``relit_a`` (S_A rho_B / pi against
                   L_d,A) and ``relit_b``, over texels seen at least three times in both

    Raises UsdBrdfError; ``output`` is then as it was.
    """
    (place_a, a), (place_b, b) = measured_atlas(Path(first)), measured_atlas(Path(second))
    with output_folder(Path(output), DOCUMENT, (place_a.folder, place_b.folder)) as work:
        sets = {key: maps for key, maps in _SETS.items() if _in_both(a, b, maps)}
        forth, back = matched(a, b), matched(b, a)
        if not (forth[1].any() and back[1].any()):
            raise InputRefused(
                f"{first}, {second}: no texel was seen three times in both. Compare captures that "
                "show the same surfaces. [compare.surface]"
            )
        for name, same in ((place_a.name, forth[0]), (place_b.name, back[0])):
            if same.missing:
                say(f"warning: only {name} has {', '.join(same.missing)}. [compare.objects]")
        found: dict[str, Any] = {
            "assets": [place_a.name, place_b.name],
            "texels": int(forth[1].sum()),
            "missing": [list(forth[0].missing), list(back[0].missing)],
        }
        rows: list[dict[str, Any]] = []
        for key, maps in sets.items():
            pair = relit(a, b, *forth, maps), relit(b, a, *back, maps)
            found[key] = _figures(*pair)
            rows += _object_rows(key, *pair)
        write_text_atomic(work / "comparison.csv", table_text(rows))
        write_pictures(work / "pictures", *pair, frames_from_stage(a.stage))
        found["objects"] = rows
        found[FILES] = [*files_of(work), DOCUMENT]
        write_json(work / DOCUMENT, found)
    return found


def comparison_line(found: dict[str, Any]) -> str:
    """One line for people, of the last set of maps."""
    key = next(key for key in reversed(_SETS) if key in found)
    titles = {"albedo": "albedo", "relit_a": "S_A rho_B", "relit_b": "S_B rho_A"}
    parts = [
        f"{title} {_percent(found[key][name]['nrmse'])} "
        f"(median {_percent(found[key][name]['median_abs_relative'])})"
        for name, title in titles.items()
    ]
    return f"{found['texels']:,} texels, NRMSE of {key}: {', '.join(parts)}"


def figures(found: dict[str, Any]) -> dict[str, Any]:
    """The content of comparison.json without objects and files."""
    return {key: value for key, value in found.items() if key not in ("objects", FILES)}


def _percent(value: float | None) -> str:
    return "unknown" if value is None else f"{100 * value:.2f} %"


def _in_both(a: AssetMaps, b: AssetMaps, maps: MapNames) -> bool:
    return all(x.has(name) for x in (a, b) for name in vars(maps).values())


def _figures(forth: Relit, back: Relit) -> dict[str, Any]:
    return {
        "albedo": errors(forth.albedo, forth.other_albedo, forth.atlas.texels.area, forth.scored),
        **{
            name: errors(r.measured, r.predicted, r.atlas.texels.area, r.scored)
            for name, r in (("relit_a", forth), ("relit_b", back))
        },
    }


def _object_rows(key: str, forth: Relit, back: Relit) -> list[dict[str, Any]]:
    """The same per object of A; B's object is the one of the same identifier."""
    owner, other = forth.atlas.texels.object_index(), back.atlas.texels.object_index()
    theirs = [obj.identifier for obj in back.atlas.scene.objects]
    rows = []
    for i, obj in enumerate(forth.atlas.scene.objects):
        own = forth.scored & (owner == i)
        if not own.any():
            continue
        area = forth.atlas.texels.area
        row: dict[str, Any] = {"maps": key, "object": obj.identifier, "texels": int(own.sum())}
        figures = {
            "albedo": errors(forth.albedo, forth.other_albedo, area, own),
            "relit_a": errors(forth.measured, forth.predicted, area, own),
        }
        if obj.identifier in theirs:
            part = back.scored & (other == theirs.index(obj.identifier))
            figures["relit_b"] = errors(back.measured, back.predicted, back.atlas.texels.area, part)
        for name in ("albedo", "relit_a", "relit_b"):
            for metric in ("nrmse", "median_abs_relative"):
                row[f"{name}_{metric}"] = figures.get(name, {}).get(metric)
        rows.append(row)
    return rows
