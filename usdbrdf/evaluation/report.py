"""What people are given: tables of figures and one line about them, pictures of errors, a plot as
the paper's Fig. 8, and a folder of results that changes as a whole."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from usdbrdf.asset.layout import Asset
from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.files.atomic import (
    environment_failures,
    is_bare,
    make_folders,
    publish,
    temporary_beside,
    temporary_folder,
    write_text_atomic,
)
from usdbrdf.files.documents import read_json, write_json
from usdbrdf.job.progress import say
from usdbrdf.model.arrays import Bool, Byte, Float

Row: TypeAlias = Mapping[str, Any]
# metric -> whether more of it is better
_METRICS = {"l2": False, "l2_with_lamps": False, "l2_shown": False, "flip": False, "psnr": True}
# Matplotlib's magma (CC0) at nine equal steps, as FLIP shows its maps; linear in between.
_MAGMA = np.array(
    [(0, 0, 4), (28, 16, 68), (79, 18, 123), (129, 37, 129), (181, 54, 122), (229, 80, 100),
     (251, 135, 97), (254, 194, 135), (252, 253, 191)], np.float32,
)  # fmt: skip
_GREY = np.array((96, 96, 96), np.uint8)
# A change of this much in FLIP gets the full colour.
_FULL_CHANGE = 0.2
_GAP = 4  # pixels between the pictures of a sheet
_LINES = (("baseline", "diffuse baseline", "tab:blue"), ("full", "full model", "tab:orange"))
_PANELS = (
    ("l2", "relative $L_2$ without lamps"),
    ("l2_shown", "the same, cut off at display white"),
    ("flip", "mean FLIP"),
)
_MARKED = 60  # so many views still get a dot each
FILES = "files"


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
        if values := summary.get(metric):
            text = f"{title} {values['baseline']:.{digits}f} -> {values['full']:.{digits}f}"
            for name, unit in (("change_percent", "%"), ("change_db", "dB")):
                text += f" ({values[name]:+.1f} {unit})" if name in values else ""
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


def magma(error: Float, counted: Bool) -> Byte:
    """(H, W, 3) sRGB of errors (H, W), black at 0 and pale yellow from 1; grey: not counted."""
    steps = np.linspace(0, 1, len(_MAGMA))
    level = np.clip(np.nan_to_num(error), 0, 1)
    colour = np.stack([np.interp(level, steps, _MAGMA[:, c]) for c in range(3)], axis=-1)
    return np.where(counted[..., None], (colour + 0.5).astype(np.uint8), _GREY)


def change(before: Float, after: Float, counted: Bool) -> Byte:
    """(H, W, 3) sRGB of what became of an error (H, W): blue smaller, orange larger, black same."""
    amount = np.clip((after - before) / _FULL_CHANGE, -1, 1)[..., None]
    smaller, larger = np.array((70, 150, 255.0)), np.array((255, 140, 40.0))
    colour = np.maximum(-amount, 0) * smaller + np.maximum(amount, 0) * larger
    return np.where(counted[..., None], (colour + 0.5).astype(np.uint8), _GREY)


def sheet(rows: Sequence[Sequence[Byte]]) -> Byte:
    """Pictures of one size side by side, rows below each other, with white gaps."""
    height, width = rows[0][0].shape[:2]
    columns = max(len(row) for row in rows)
    shape = len(rows) * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3
    whole = np.full(shape, 255, np.uint8)
    for j, row in enumerate(rows):
        for i, picture in enumerate(row):
            top, left = j * (height + _GAP), i * (width + _GAP)
            whole[top : top + height, left : left + width] = picture
    return whole


def parts_of_sheet(whole: Float, rows: int, columns: int) -> list[Float]:
    """The pictures of a ``sheet``, row by row."""
    height = (whole.shape[0] + _GAP) // rows - _GAP
    width = (whole.shape[1] + _GAP) // columns - _GAP
    corners = [
        (j * (height + _GAP), i * (width + _GAP)) for j in range(rows) for i in range(columns)
    ]
    return [whole[top : top + height, left : left + width] for top, left in corners]


def write_prose(path: Path, text: str) -> None:
    """A result. EnvironmentFailure where the disk does not take it."""
    with environment_failures(str(path)):
        write_text_atomic(path, text)


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """The same rows for programs, as CSV."""
    write_prose(path, table_text(rows))


def write_document(work: Path, document: str, found: dict[str, Any]) -> None:
    """What lists all that was written, last; adds the list to ``found``."""
    found[FILES] = [*files_of(work), document]
    with environment_failures(str(work / document)):
        write_json(work / document, found)


def write_plot(path: Path, rows: Sequence[Row]) -> None:
    """Panels of L2 and FLIP over the rows ``l2_baseline``, ``l2_full``, ... as PNG or SVG.

    Without matplotlib nothing is drawn, and one line says so. Its settings, of which it takes those
    in the current folder for the user's, play no part.
    """
    unread = f"{path.name}: not drawn, matplotlib cannot read its settings, matplotlibrc"
    # It would wait for a FIFO for ever; folders it passes over.
    found = Path("matplotlibrc")
    if os.path.exists(found) and not (os.path.isfile(found) or os.path.isdir(found)):
        say(f"{unread} (no regular file).")
        return
    try:
        from matplotlib import rc_context, rcdefaults
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        say(f"{path.name}: not drawn, matplotlib is missing. Install usdbrdf[report].")
        return
    except (OSError, ValueError) as error:
        say(f"{unread} ({error}).")
        return
    with rc_context():
        rcdefaults()
        figure = Figure(figsize=(15, 4), layout="constrained")
        FigureCanvasAgg(figure)
        _draw_panels(figure, rows)
        # Equal rows give equal bytes.
        metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
        with (
            environment_failures(str(path)),
            temporary_beside(path) as staged,
            rc_context({"svg.hashsalt": "usdbrdf"}),
        ):
            figure.savefig(staged, dpi=110, format=path.suffix[1:], metadata=metadata)
            publish(staged, path)


def _draw_panels(figure: Any, rows: Sequence[Row]) -> None:
    for axes, (metric, title) in zip(figure.subplots(1, len(_PANELS)), _PANELS, strict=True):
        for key, label, colour in _LINES:
            values = np.array([row[f"{metric}_{key}"] for row in rows], float)
            mark = "o" if len(rows) <= _MARKED else None
            axes.plot(values, label=label, color=colour, marker=mark, markersize=3, linewidth=1.2)
            if np.isfinite(values).any():
                axes.axhline(np.nanmean(values), color=colour, linestyle=":", linewidth=1)
        axes.set(xlabel="view", title=title)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    axes.legend()


@contextmanager
def output_folder(folder: Path, document: str, assets: tuple[Asset, ...]) -> Iterator[Path]:
    """A new folder to write into; at the end its files are in ``folder``, ``document`` last.

    The document (JSON) lists under ``files`` what lies beside it; of an earlier run those that are
    not made again are deleted, nothing else. While files are put in place it holds nothing but that
    list, so that whoever is killed then leaves a folder that the next run knows and nobody reads.
    After an error before that ``folder`` is as it was.
    Raises UsageError for a folder inside one of ``assets``, OwnershipConflict for one that holds
    files but no such document.
    """
    folder = Path(os.path.abspath(folder))
    for asset in assets:
        asset.refuse_output(folder, "evaluate.output")
    if folder.exists() and not folder.is_dir():
        raise OwnershipConflict(f"{folder}: not a folder. Name another with -o. [evaluate.output]")
    earlier: object = None if folder.is_dir() and not is_bare(folder) else []
    if (folder / document).is_file():
        with suppress(InputRefused, AttributeError):
            earlier = read_json(folder / document).get(FILES)
    if not isinstance(earlier, list) or not all(isinstance(name, str) for name in earlier):
        raise OwnershipConflict(
            f"{folder}: holds files but no {document} of ours. Name an empty or a new folder with "
            "-o. [evaluate.output]"
        )
    with ExitStack() as held:
        with environment_failures(str(folder)):
            work = held.enter_context(temporary_folder(folder))
        yield work
        with environment_failures(str(folder)):
            made = files_of(work)
            make_folders(folder)
            write_json(folder / document, {FILES: sorted({*earlier, *made})})
            for relative in sorted(made, key=lambda name: name == document):
                make_folders((folder / relative).parent)
                publish(work / relative, folder / relative)
            for relative in set(earlier) - set(made):
                stale = (folder / relative).resolve()
                if stale.is_relative_to(folder.resolve()) and stale.is_file():
                    stale.unlink()


def files_of(work: Path) -> list[str]:
    """What was written so far, relative, for the document's list."""
    return sorted(p.relative_to(work).as_posix() for p in work.rglob("*") if p.is_file())
