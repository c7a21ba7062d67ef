"""Records that are not JSON: rows of numbers, CSV, XML and single arrays, each within the limits of
``documents``."""

from __future__ import annotations

import csv
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np

from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import raise_shortage
from usdbrdf.files.documents import (
    DAMAGED_ARRAYS,
    MAX_BYTES,
    MAX_DEPTH,
    encoding_of_text,
    read_text,
    refusal_of_arrays,
)
from usdbrdf.files.paths import seen_of, why_not_fetched
from usdbrdf.model.arrays import Array, Double

Element = ElementTree.Element


def files_of(path: Path, suffixes: Collection[str]) -> list[Path]:
    """The files in a folder, or the one that ``path`` is, that end in one of these suffixes, which
    are small letters, in letters of any case."""
    files = seen_of(path.iterdir()) if path.is_dir() else [path]
    return [file for file in files if file.suffix.lower() in suffixes and file.is_file()]


def only_one(found: Sequence[Path], path: Path, called: str, how: str) -> Path:
    """The document of a capture; InputRefused, which says what such are ``called`` and ``how`` to
    go on, where there are none or several."""
    if len(found) != 1:
        raise InputRefused(f"{path}: {len(found) or 'no'} {called}. {how}. [capture.format]")
    return found[0]


def beginning_of(path: Path, num_bytes: int = 2000) -> bytes:
    """A file's first bytes, for a glance at what it is; none where there is no file to read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(num_bytes)
    except OSError as error:
        raise_shortage(error)
        return b""


def beginning_of_text(path: Path) -> str:
    """The same of a text, whatever it is written in."""
    head = beginning_of(path)
    return head.decode(encoding_of_text(head), "replace")


def beginning_in_utf8(path: Path) -> bytes:
    """The same as bytes of UTF-8 without a mark, for what is known by how it begins."""
    return beginning_of_text(path).encode()


def number_rows(path: Path, *, most: int | None = None) -> tuple[Double, ...]:
    """Each line's numbers, (n,) float64, separated by blanks or commas; lines without any, and
    what follows a #, are passed over. NaN and infinities are for the caller to judge.

    most  of so many lines, the first that have any
    """
    rows: list[Double] = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if len(rows) == most:
            break
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


def csv_rows(path: Path, names: Collection[str] = ()) -> tuple[dict[str, str], ...]:
    """Rows of a CSV file by the names of its header, which is the first line that has all of
    ``names``; these lose their case, blanks and a leading #.

    Commas, semicolons, tabs, or what a first line sep= says separate; numbers may have decimal
    commas. Empty rows and remarks are passed over: what a # begins, or rows of another length
    without any number.
    """
    lines = read_text(path).splitlines()
    said = re.match(r"sep=([,;|\t])$", lines[0].strip('\ufeff"'), re.IGNORECASE) if lines else None
    lines = [line for line in lines[1 if said else 0 :] if line.strip()]
    try:
        found = _table(lines, said[1] if said else "", {*names})
    except csv.Error as error:
        raise InputRefused(
            f"{path}: not a table ({error}). Export it again. [document.table]"
        ) from error
    if found is None:
        raise InputRefused(f"{path}: no table with a header. Export it again. [document.table]")
    header, table = found
    rows = []
    for row in table:
        values = [value.strip() for value in row]
        if len(values) == len(header):
            if any(values):
                named = zip(header, values, strict=True)
                rows.append({k: v if k in _NO_NUMBERS else _with_point(v) for k, v in named})
        elif not values[0].startswith("#") and any(_is_number(_with_point(v)) for v in values):
            raise InputRefused(
                f"{path}: the row {', '.join(row)[:60]!r} has {len(row)} values under "
                f"{len(header)} names. Export it again. [document.table]"
            )
    return tuple(rows)


def _table(
    lines: Sequence[str], separator: str, names: Collection[str]
) -> tuple[list[str], list[list[str]]] | None:
    """The names of a header and the rows below it; None without one."""
    for i, line in enumerate(lines):
        by = separator or max(_SEPARATORS, key=line.count)
        header = [name.strip(" #").lower() for name in next(csv.reader([line], delimiter=by))]
        if by in line and set(names) <= set(header):
            return header, list(_rows(lines[i + 1 :], by))
    return None


def _rows(lines: Sequence[str], separator: str) -> Iterator[list[str]]:
    """csv.Error for a quote that nothing closes: all lines behind it would be part of one word."""
    reader, begun = csv.reader([*lines, ""], delimiter=separator), 0
    for row in reader:
        if begun < len(lines) < reader.line_num:
            raise csv.Error(f"nothing closes the quote in the row {lines[begun][:60]!r}")
        begun = reader.line_num
        if row:
            yield row


_SEPARATORS = ",;\t"
_NO_NUMBERS = frozenset(("name",))  # columns of words, whatever they look like


def _with_point(value: str) -> str:
    return value.replace(",", ".") if re.fullmatch(_DECIMAL_COMMA, value) else value


_DECIMAL_COMMA = r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?"


def _is_number(value: str) -> bool:
    return number_in({"": value}, "") is not None


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


def numbers_among(value: object, count: int) -> Double | None:
    """A value of a JSON document, lists or not, as ``count`` finite numbers, which may be written
    as texts; None where it holds anything else."""
    try:
        values = np.array(value, np.float64).ravel()
    except (TypeError, ValueError, OverflowError):
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
        if (why := why_not_fetched(path)) is not None:
            raise InputRefused(f"{path}: {why}. [arrays.pointer]")
        # Mapped: a header may announce any size, and only what the file holds can be mapped.
        return np.array(np.load(path, mmap_mode="r", allow_pickle=False))
    except DAMAGED_ARRAYS as error:
        raise refusal_of_arrays(path, error) from error
