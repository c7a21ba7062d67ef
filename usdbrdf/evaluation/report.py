"""Rows of figures, what is said of all of them, and a folder of results that changes as a whole."""

from __future__ import annotations

import csv
import io
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.atomic import TEMPORARY_PREFIX, environment_failures, publish
from usdbrdf.files.documents import read_json

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


FILES = "files"


@contextmanager
def output_folder(folder: Path, document: str, assets: tuple[Path, ...]) -> Iterator[Path]:
    """A new folder to write into; at the end its files are in ``folder``, ``document`` last.

    The document (JSON) lists under ``files`` what lies beside it; of an earlier run those that are
    not made again are deleted, nothing else. After an error ``folder`` is as it was.
    Raises UsageError for a folder inside one of ``assets``, OwnershipConflict for one that holds
    files but no such document.
    """
    folder = Path(os.path.abspath(folder))
    for asset in assets:
        if folder.resolve().is_relative_to(asset.resolve()):
            raise UsageError(
                f"{folder}: lies inside the asset {asset}, which stays as it is. Name another "
                "folder with -o. [evaluate.output]"
            )
    earlier = _earlier_files(folder, document)
    with environment_failures(str(folder)):
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=TEMPORARY_PREFIX, dir=folder.parent))
    try:
        yield work
        with environment_failures(str(folder)):
            _move(work, folder, document, earlier)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def files_of(work: Path) -> list[str]:
    """What was written so far, relative, for the document's list."""
    return sorted(p.relative_to(work).as_posix() for p in work.rglob("*") if p.is_file())


def _earlier_files(folder: Path, document: str) -> list[str]:
    if folder.exists() and not folder.is_dir():
        raise OwnershipConflict(f"{folder}: not a folder. Name another with -o. [evaluate.output]")
    if not folder.is_dir() or not any(folder.iterdir()):
        return []
    known: object = None
    if (folder / document).is_file():
        try:
            known = read_json(folder / document).get(FILES)
        except (InputRefused, AttributeError):
            known = None
    if not isinstance(known, list) or not all(isinstance(name, str) for name in known):
        raise OwnershipConflict(
            f"{folder}: holds files but no {document} of ours. Name an empty or a new folder with "
            "-o. [evaluate.output]"
        )
    return known


def _move(work: Path, folder: Path, document: str, earlier: list[str]) -> None:
    made = files_of(work)
    for relative in sorted(made, key=lambda name: name == document):
        (folder / relative).parent.mkdir(parents=True, exist_ok=True)
        publish(work / relative, folder / relative)
    for relative in set(earlier) - set(made):
        stale = (folder / relative).resolve()
        if stale.is_relative_to(folder.resolve()) and stale.is_file():
            stale.unlink()
