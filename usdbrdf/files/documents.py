"""Records in files: JSON without its traps (finite numbers, no key twice, bounded size and depth),
and named arrays as an uncompressed .npz without pickles and with fixed bytes.
"""

from __future__ import annotations

import codecs
import json
import math
import os
import re
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import naming, raise_shortage, write_text_atomic
from usdbrdf.files.paths import why_not_fetched
from usdbrdf.model.arrays import Array

# Not msgspec: it keeps the last of two equal keys without a word, takes no NaN even where the
# caller is to judge it, and names the byte of a fault, not its line.

MAX_BYTES = 256 << 20
MAX_DEPTH = 64
_MAX_ARRAY_BYTES = 4 << 30  # of one that is stored smaller
_INTEGER_LIMIT, _UNSIGNED_LIMIT = 1 << 63, 1 << 64
_HALF_A_PAIR = re.compile(r"\\u[dD][89a-fA-F]")  # or half of a whole one
# What XML may say that it is written in, of what has a letter in each byte.
_OF_ONE_BYTE = re.compile(
    rb"<\?xml[^>]{1,99}?encoding=[\"'](iso-8859-(?:1[0134-6]?|[2-9])|windows-125[0-8])[\"']", re.I
)
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[\[\]{},:]|[^\s\[\]{},:"]+', re.DOTALL)


class _BadNumber(ValueError):
    """A number that is not finite or does not fit 64 bits."""


class _KeyTwice(ValueError):
    """An object names one key two times."""


def read_json(path: Path, *, nonfinite_below: Collection[str] = (), unsigned: bool = False) -> Any:
    """Parse a JSON document strictly; InputRefused names the file and, where known, the line.

    ``json`` alone would take NaN, turn 1e999 into infinity and keep the last of two equal keys.

    nonfinite_below  keys whose values may hold NaN and infinities, for the caller to judge
    unsigned         whether whole numbers may be such of 64 bits without a sign, as what stands for
                     a picture's content often is
    """
    integer = partial(_integer, limit=_UNSIGNED_LIMIT if unsigned else _INTEGER_LIMIT)
    text = read_text(path)
    too_deep = InputRefused(
        f"{path}: nested deeper than {MAX_DEPTH} levels. This is not a document of ours; check "
        "what wrote it. [document.depth]"
    )
    try:
        try:
            document = _parsed(text, _finite, integer)
        except _BadNumber:
            document = _parsed(text, float, integer)
            if _any_nonfinite(document, nonfinite_below):
                raise
    except (_BadNumber, _KeyTwice) as error:
        shown = repr(str(error) if len(str(error)) <= 40 else f"{str(error)[:40]}...")
        number = f"the number {shown} is not a finite 64-bit number. Remove or correct it"
        twice = f"the key {shown} occurs twice in one object. Keep one of the two"
        said, rule = (twice, "duplicate") if isinstance(error, _KeyTwice) else (number, "nonfinite")
        line = _line_of_fault(text, error)
        raise InputRefused(f"{path}:{line}: {said}. [document.{rule}]") from error
    except json.JSONDecodeError as error:
        raise InputRefused(
            f"{path}:{error.lineno}: not valid JSON ({error.msg}, column {error.colno}). Export "
            "it again or correct it. [document.json]"
        ) from error
    except RecursionError as error:
        raise too_deep from error
    level = [node for node in (document,) if isinstance(node, dict | list)]
    for _ in range(MAX_DEPTH):
        children = (c for node in level for c in (node.values() if type(node) is dict else node))
        level = [child for child in children if isinstance(child, dict | list)]
    if level:
        raise too_deep
    if _HALF_A_PAIR.search(text):
        try:
            json.dumps(document, ensure_ascii=False).encode()
        except UnicodeEncodeError as error:
            raise InputRefused(
                f"{path}: a string holds half of a surrogate pair, which no text has. Correct it. "
                "[document.json]"
            ) from error
    return document


def write_json(path: Path, obj: Any) -> None:
    """Write JSON atomically; the same object gives the same bytes (sorted keys)."""
    write_text_atomic(path, json_text(obj))


def json_text(obj: Any) -> str:
    """The document that ``write_json`` writes; numpy numbers count as numbers."""
    try:
        return json.dumps(obj, allow_nan=False, indent=2, sort_keys=True, default=_plain) + "\n"
    except (TypeError, ValueError) as error:
        raise UsdBrdfError(
            f"a record cannot be stored as JSON: {error}. [document.write]"
        ) from error


def read_text(path: Path) -> str:
    """A whole file of UTF-8, of UTF-16 with its mark, or of XML in what it says that it is in,
    within ``MAX_BYTES``; InputRefused otherwise, unless it is the machine that fails."""
    try:
        if not path.is_file():  # a FIFO or device would block or never end
            raise InputRefused(f"{path}: no such file, or not a regular one. [document.missing]")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputRefused(
                f"{path}: {size} bytes, more than the limit of {MAX_BYTES}. Split the capture. "
                "[document.size]"
            )
        if (why := why_not_fetched(path)) is not None:
            raise InputRefused(f"{path}: {why}. [document.pointer]")
        content = path.read_bytes()
        return content.decode(encoding_of_text(content))
    except OSError as error:
        error.filename = error.filename or str(path)  # a read that fails does not say of what
        raise_shortage(error)
        raise InputRefused(
            f"{path}: cannot be read ({error.strerror}). Check its permissions. [document.missing]"
        ) from error
    except UnicodeDecodeError as error:
        encoding = "UTF-16, as its mark says" if error.encoding.startswith("utf-16") else "UTF-8"
        if error.encoding == "charmap":
            encoding = "of the encoding that its first line names"
        raise InputRefused(
            f"{path}: byte {error.start} is not {encoding}. Save the document as UTF-8. "
            "[document.json]"
        ) from error


def encoding_of_text(content: bytes) -> str:
    """What the mark at its beginning says, which spreadsheets write, or the first line of an XML
    document; UTF-8 without any."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    for encoding in ("utf-16-le", "utf-16-be"):
        if content.startswith("<?xml".encode(encoding)):
            return encoding
    declared = _OF_ONE_BYTE.match(content)
    return declared[1].decode().lower() if declared else "utf-8-sig"


def _parsed(text: str, number: Callable[[str], float], integer: Callable[[str], int]) -> Any:
    return json.loads(
        text,
        object_pairs_hook=_object_without_key_twice,
        parse_constant=number,
        parse_float=number,
        parse_int=integer,
    )


def _any_nonfinite(node: Any, exempt: Collection[str]) -> bool:
    if isinstance(node, dict):
        return any(_any_nonfinite(node[key], exempt) for key in node if key not in exempt)
    if isinstance(node, list):
        return any(_any_nonfinite(child, exempt) for child in node)
    return isinstance(node, float) and not math.isfinite(node)


def _object_without_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise _KeyTwice(key)
        result[key] = value
    return result


def _finite(token: str) -> float:
    value = float(token)
    if not math.isfinite(value):
        raise _BadNumber(token)
    return value


def _integer(token: str, *, limit: int) -> int:
    # 20 digits always fit int(); longer ones may exceed Python's own digit limit.
    if len(token) > 20 or not -_INTEGER_LIMIT <= int(token) < limit:
        raise _BadNumber(token)
    return int(token)


def _line_of_fault(text: str, error: _BadNumber | _KeyTwice) -> int:
    """The line of the first such number, or of the first key that occurs twice."""
    keys: list[set[str]] = []
    line, position, previous = 1, 0, ""
    for match in _TOKEN.finditer(text):
        token = match.group()
        line += text.count("\n", position, match.start())
        position = match.start()
        if token in "{[":
            keys.append(set())
        elif token in "}]":
            keys.pop()
        elif token == ":":
            key = json.loads(previous, strict=False)
            if isinstance(error, _KeyTwice) and key in keys[-1]:
                break
            keys[-1].add(key)
        elif isinstance(error, _BadNumber) and token == str(error):
            break
        previous = token
    return line


def _plain(value: object) -> object:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} is not a JSON type")


def save_arrays(path: Path, arrays: Mapping[str, Array]) -> None:
    """Write arrays; object arrays raise ValueError. (np.savez would not take the key "file".)"""
    with (
        naming(path),
        path.open("wb") as file,
        zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive,
    ):
        for key, array in arrays.items():
            member = zipfile.ZipInfo(f"{key}.npy")  # its date is 1980, so equal arrays, equal bytes
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def load_arrays(path: Path) -> dict[str, Array]:
    """Read all arrays of a file; a damaged one or one that holds pickles is refused, and one that
    says of itself that it is larger than what is there."""
    try:
        if not path.is_file():
            raise FileNotFoundError("no such file, or not a regular one")
        with path.open("rb") as file, zipfile.ZipFile(file) as archive:
            return {
                item.filename.removesuffix(".npy"): _array_of(archive, item)
                for item in archive.infolist()
            }
    except DAMAGED_ARRAYS as error:
        raise refusal_of_arrays(path, error) from error


# What NumPy and zipfile stumble over: a header is parsed as Python, parts of a file are inflated.
DAMAGED_ARRAYS = (
    OSError, ValueError, EOFError, AttributeError, TypeError, SyntaxError, OverflowError,
    RuntimeError, tokenize.TokenError, zlib.error, zipfile.BadZipFile,
)  # fmt: skip


def refusal_of_arrays(path: Path, error: Exception) -> InputRefused:
    """The sentence about a file of arrays that cannot be read, in one line. Raises that of a
    machine that can read none, if that is why."""
    raise_shortage(error)
    said = " ".join(str(error).split())[:200]
    return InputRefused(
        f"{path}: not a readable array file ({said}); pickled data is refused. Write it again. "
        "[arrays.damaged]"
    )


def _array_of(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> Array:
    """One array, once its header is known to announce no more than its part holds."""
    if item.file_size > max(_MAX_ARRAY_BYTES, item.compress_size):
        raise ValueError(f"{item.compress_size} bytes are to become {item.file_size}")
    reads = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
    with archive.open(item) as stream:
        shape, _, dtype = reads[np.lib.format.read_magic(stream)[0] > 1](stream)
    if not dtype.hasobject and math.prod(shape) * dtype.itemsize > item.file_size:
        raise ValueError(f"{item.file_size} bytes are to hold an array of {shape} {dtype}")
    with archive.open(item) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
