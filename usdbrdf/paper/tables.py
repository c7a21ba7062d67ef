"""Rows of the paper's tables, of what ``compare`` and ``evaluate`` compute and the fits say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.evaluation.metrics import finite
from usdbrdf.evaluation.report import Row

# Of Fig. 5: what is compared with what.
QUANTITIES = {
    "albedo": "rho_A, rho_B",
    "relit_a": "S_A rho_A, S_A rho_B",
    "relit_b": "S_B rho_B, S_B rho_A",
}
_SETS = ("lit", "diffuse")
_METRICS = ("l2", "flip")


def albedo_rows(found: dict[str, Any]) -> list[Row]:
    """The numbers of Fig. 5, per set of maps."""
    return [
        {"maps": key, "compared": told, **found[key][name]}
        for key in _SETS
        if key in found
        for name, told in QUANTITIES.items()
    ]


def material_rows(a: AssetMaps, b: AssetMaps) -> list[Row]:
    """phi and psi of the objects that both assets have, by identifier, with their differences;
    ``deviations`` is a difference in units of its stated error, None where none is stated."""
    theirs = {obj.identifier: read_fit(b.stage, obj.prim_path) for obj in b.scene.objects}
    rows: list[Row] = []
    for obj in a.scene.objects:
        own, other = read_fit(a.stage, obj.prim_path), theirs.get(obj.identifier)
        if own is None or other is None:
            continue
        row: dict[str, Any] = {"object": obj.identifier}
        for name, fit in (("a", own), ("b", other)):
            row[f"status_{name}"] = fit.status
            row |= {
                f"{number}_{name}": finite(getattr(fit, number), 4)
                for number in ("phi", "phi_error", "psi", "psi_error")
            }
        for number in ("phi", "psi"):
            row |= _difference(number, own, other)
        rows.append(row)
    return rows


def _difference(number: str, one: FittedObject, other: FittedObject) -> dict[str, float | None]:
    away = getattr(other, number) - getattr(one, number)
    error = math.hypot(*(getattr(fit, f"{number}_error") for fit in (one, other)))
    deviations = away / error if error > 0 else math.nan
    return {f"{number}_difference": finite(away, 4), f"{number}_deviations": finite(deviations, 2)}


def changes(rows: Sequence[Row]) -> dict[str, dict[str, Any]]:
    """Per metric: in how many views the full model is better and worse than the diffuse baseline,
    and by how much in the mean of those (paper, section 4.2: what improves, improves by more)."""
    found = {}
    for metric in _METRICS:
        pairs = [(row[f"{metric}_baseline"], row[f"{metric}_full"]) for row in rows]
        known = np.array([pair for pair in pairs if None not in pair], float).reshape(-1, 2)
        change = known[:, 1] - known[:, 0]
        better, worse = change[change < 0], change[change > 0]
        found[metric] = {
            "views": len(change),
            "better_views": len(better),
            "mean_improvement": float(-better.mean()) if len(better) else None,
            "worse_views": len(worse),
            "mean_deterioration": float(worse.mean()) if len(worse) else None,
        }
    return found
