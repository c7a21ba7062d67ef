"""Records that are not JSON: rows of numbers, CSV, XML and single arrays, each within the limits of
``documents``."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import (
    DAMAGED_ARRAYS,
    MAX_BYTES,
    MAX_DEPTH,
    read_text,
    refusal_of_arrays,
)
from usdbrdf.model.arrays import Array, Double

Element = ElementTree.Element


def files_of(path: Path, suffixes: Collection[str]) -> list[Path]:
    """The files in a folder, or the one that ``path`` is, that end in one of these suffixes, which
    are small letters, in letters of any case."""
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    return [file for file in files if file.suffix.lower() in suffixes and file.is_file()]


def beginning_of(path: Path, num_bytes: int = 2000) -> bytes:
    """A file's first bytes, for a glance at what it is; none where there is no file to read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(num_bytes)
    except OSError:
        return b""


def number_rows(path: Path) -> tuple[Double, ...]:
    """Each line's numbers, (n,) float64, separated by blanks or commas; lines without any, and
    what follows a #, are passed over. NaN and infinities are for the caller to judge."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        numbers = line.partition("#")[0].replace(",", " ")
        if not numbers.strip():
            continue
        try:
            rows.append(np.array(numbers.split(), np.float64))
        except ValueError as error:
            raise InputRefused(
                f"{path}:{number}: not a row of numbers ({line.strip()[:60]!r}). Export it again. "
                "[document.table]"
            ) from error
    return tuple(rows)


def csv_rows(path: Path) -> tuple[dict[str, str], ...]:
    """Rows of a CSV file by the names of its header, which is the first line with a comma; names
    lose their case, blanks and a leading #. Comma or semicolon separates."""
    lines = [line for line in read_text(path).splitlines() if re.search("[,;]", line)]
    if not lines:
        raise InputRefused(f"{path}: no table with a header. Export it again. [document.table]")
    separator = max(",;", key=lines[0].count)
    table = list(csv.reader(lines, delimiter=separator))
    names = [name.strip().lstrip("#").strip().lower() for name in table[0]]
    short = next((row for row in table[1:] if len(row) != len(names)), None)
    if short is not None:
        raise InputRefused(
            f"{path}: the row {separator.join(short)[:60]!r} has {len(short)} values under "
            f"{len(names)} names. Export it again. [document.table]"
        )
    return tuple(dict(zip(names, (v.strip() for v in row), strict=True)) for row in table[1:])


def read_xml(path: Path) -> Element:
    """The root of an XML document without a document type, in which entities would multiply."""
    text = read_text(path)
    if re.search("<!(DOCTYPE|ENTITY)", text, re.IGNORECASE):
        raise InputRefused(
            f"{path}: an XML document with a document type, which none of the formats read here "
            "has. Export it again. [document.xml]"
        )
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    depth, root = 0, cast(Element | None, None)
    try:
        for start in range(0, len(text), 1 << 16):
            parser.feed(text[start : start + (1 << 16)])
            for event, element in parser.read_events():
                depth += 1 if event == "start" else -1
                root = element if root is None else root
                if depth > MAX_DEPTH:
                    raise InputRefused(
                        f"{path}: nested deeper than {MAX_DEPTH} levels. Export it again. "
                        "[document.depth]"
                    )
        parser.close()
    except ElementTree.ParseError as error:
        raise InputRefused(
            f"{path}: not valid XML ({error}). Export it again. [document.xml]"
        ) from error
    if root is None:
        raise InputRefused(f"{path}: an empty XML document. Export it again. [document.xml]")
    return root


def numbers_of(element: Element | None, count: int) -> Double | None:
    """An element's text as ``count`` finite numbers, or None where it holds anything else."""
    words = (element.text or "").split() if element is not None else []
    try:
        values = np.array(words, np.float64)
    except ValueError:
        return None
    return values if len(values) == count and np.isfinite(values).all() else None


def number_in(row: Mapping[str, str | None], *names: str) -> float | None:
    """The number under the first of ``names`` that a row of text has; None where it is none."""
    text = next((row[name] for name in names if row.get(name)), None)
    try:
        value = float(text) if text else None
    except ValueError:
        return None
    return value if value is not None and np.isfinite(value) else None


def read_array(path: Path) -> Array:
    """The array of a .npy file; a damaged one, or one that holds pickles, is refused."""
    try:
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            raise InputRefused(
                f"{path}: no regular file of up to {MAX_BYTES} bytes. Export it again. "
                "[arrays.damaged]"
            )
        # Mapped: a header may announce any size, and only what the file holds can be mapped.
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except DAMAGED_ARRAYS as error:
        raise refusal_of_arrays(path, error) from error
