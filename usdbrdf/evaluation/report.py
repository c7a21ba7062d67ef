"""Rows of figures -> what is said of all of them, and a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from typing import Any

Row = Mapping[str, Any]

# metric -> whether more of it is better
_METRICS = {"l2": False, "l2_with_lamps": False, "l2_shown": False, "flip": False, "psnr": True}


def summary_of_views(rows: Sequence[Row]) -> dict[str, Any]:
    """Per metric the means of both models over the views, their change (in % of the baseline; PSNR
    in dB) and in how many views the full model is worse."""
    found: dict[str, Any] = {"views": len(rows)}
    for metric, more_is_better in _METRICS.items():
        pairs = [(row[f"{metric}_baseline"], row[f"{metric}_full"]) for row in rows]
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        if not known:
            continue
        before, after = (sum(column) / len(known) for column in zip(*known, strict=True))
        found[metric] = {
            "baseline": before,
            "full": after,
            "worse_views": sum((a > b) if more_is_better else (b > a) for a, b in known),
        }
        if metric == "psnr":
            found[metric]["change_db"] = after - before
        elif before > 0:
            found[metric]["change_percent"] = 100 * (after / before - 1)
    return found


def summary_line(summary: Mapping[str, Any]) -> str:
    """One line for people."""
    parts = []
    for metric, title, digits in (
        ("flip", "FLIP", 4),
        ("l2", "L2", 4),
        ("l2_shown", "L2 below white", 4),
        ("psnr", "PSNR", 1),
    ):
        values = summary.get(metric)
        if values is None:
            continue
        text = f"{title} {values['baseline']:.{digits}f} -> {values['full']:.{digits}f}"
        if "change_percent" in values:
            text += f" ({values['change_percent']:+.1f} %)"
        if "change_db" in values:
            text += f" ({values['change_db']:+.1f} dB)"
        parts.append(text)
    worse = summary.get("flip", {}).get("worse_views", 0)
    return (
        f"{summary['views']} views, diffuse baseline -> full model: {', '.join(parts)}; "
        f"{worse} worse than the baseline by FLIP"
    )


def truth_line(truth: Mapping[str, Any]) -> str:
    """One line for people, of what ``compare_with_truth`` found."""
    albedo, material = truth["albedo"], truth["material"]
    numbers = {
        "albedo NRMSE": albedo["nrmse"],
        "median relative error": albedo["median_abs_relative"],
        "mean error of phi": material["mean_abs_phi"],
        "of psi": material["mean_abs_psi"],
        f"of the {material['measured']} measured objects phi": material["measured_mean_abs_phi"],
        "psi": material["measured_mean_abs_psi"],
    }
    known = (f"{name} {value:.4f}" for name, value in numbers.items() if value is not None)
    return f"against the truth: {', '.join(known)}"


def table_text(rows: Sequence[Row]) -> str:
    """The rows as CSV with a header; unknown numbers are empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
