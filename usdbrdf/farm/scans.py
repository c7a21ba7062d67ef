"""Which scans a farm converts: their list in a file, and a name for each that its folder gets."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.documents import read_json, read_text, write_json
from usdbrdf.files.naming import unique_identifiers

SCANS_FILE = "scans.json"
RESULTS_FOLDER = "results"
_SCHEMA = 1
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9})(?::([1-9]\d{0,8}))?)?")


@dataclass(frozen=True, kw_only=True)
class ScanList:
    """The scans of a bundle, numbered from 1 in this order.

    root    folder above all of them, where it was when the list was made
    names   of each: of its asset's folder, its page and its record
    places  of each, relative to ``root``
    """

    root: Path
    names: tuple[str, ...]
    places: tuple[str, ...]


def listed_in(file: Path) -> list[Path]:
    """The scans that a text file names, one a line, relative to its folder; "#" begins a comment.

    InputRefused for a file that cannot be read."""
    lines = (line.strip() for line in read_text(file).splitlines())
    return [file.parent / line for line in lines if line and not line.startswith("#")]


def list_of(scans: Sequence[Path]) -> ScanList:
    """The list of these capture folders or main files, each once, with names that depend on their
    places alone and not on their order. UsageError where there are none, InputRefused where one is
    not there."""
    places = [*dict.fromkeys(Path(os.path.abspath(scan)) for scan in scans)]
    if not places:
        raise UsageError("no scans: name some, or a --list FILE that does. [farm.scans]")
    missing = [place for place in places if not place.exists()]
    if missing:
        more = f" (and {len(missing) - 1} others of the list)" if len(missing) > 1 else ""
        raise InputRefused(
            f"{missing[0]}: no such file or folder{more}. Correct the path; nothing was written. "
            "[farm.scan]"
        )
    root = Path(os.path.commonpath([place.parent for place in places]))
    return ScanList(
        root=root,
        names=tuple(_names(places)),
        places=tuple(place.relative_to(root).as_posix() for place in places),
    )


def _names(places: Sequence[Path]) -> list[str]:
    """A folder's name, a main file's behind that of its folder, with as many of the folders above
    as tell it from all others; identifiers, for they become names of files and prims."""
    files = [place.is_file() for place in places]
    parts = [
        (place.with_suffix("") if is_file else place).parts[1:] or ("scan",)
        for place, is_file in zip(places, files, strict=True)
    ]
    depth = [1 + is_file for is_file in files]
    while True:
        labels = ["_".join(part[-d:]) for part, d in zip(parts, depth, strict=True)]
        deeper = [
            d + (labels.count(label) > 1 and d < len(part))
            for label, part, d in zip(labels, parts, depth, strict=True)
        ]
        if deeper == depth:
            break
        depth = deeper
    in_order = sorted(range(len(places)), key=lambda i: parts[i])
    found = unique_identifiers([labels[i] for i in in_order])
    names = dict(zip(in_order, found, strict=True))
    return [names[i] for i in range(len(places))]


def write_list(folder: Path, scans: ScanList) -> None:
    """Write the list into a bundle. OwnershipConflict where a name stands for another scan there:
    the asset that has it would be taken for that scan's."""
    file = folder / SCANS_FILE
    if file.is_file():
        before = read_list(file)
        known = dict(zip(before.names, (before.root / p for p in before.places), strict=True))
        for name, place in zip(scans.names, scans.places, strict=True):
            if known.get(name, scans.root / place) != scans.root / place:
                raise OwnershipConflict(
                    f"{file}: {name} is the scan {known[name]} here, not {scans.root / place}. "
                    "Choose another folder with -o. [farm.name]"
                )
    rows = [{"name": n, "place": p} for n, p in zip(scans.names, scans.places, strict=True)]
    write_json(file, {"schema": _SCHEMA, "root": str(scans.root), "scans": rows})


def read_list(file: Path) -> ScanList:
    """The list of a bundle, or InputRefused."""
    document = read_json(file)
    try:
        rows = document["scans"]
        known = document["schema"] == _SCHEMA and isinstance(document["root"], str)
        names, places = (tuple(row[key] for row in rows) for key in ("name", "place"))
        safe = all(re.fullmatch(r"\w+", name, re.ASCII) for name in names)
        safe &= all(isinstance(place, str) for place in places)
    except (KeyError, TypeError):
        known = safe = False
    if not (known and safe and rows):
        raise InputRefused(
            f"{file}: no list of scans that usdbrdf farm wrote. Write the bundle again. [farm.list]"
        )
    return ScanList(root=Path(document["root"]), names=names, places=places)


def numbers_in(text: str, count: int) -> list[int]:
    """The numbers that a range of OpenJD means ("7", "1-5", "1-9:2,12"), of 1 to ``count``, sorted;
    UsageError for what is no such range."""
    found: set[int] = set()
    for part in text.split(","):
        matched = _RANGE.fullmatch(part.replace(" ", ""))
        if matched is None:
            raise UsageError(f"--scans {text}: expected numbers such as 3 or 1-5. [farm.range]")
        first, last, step = matched.groups()
        found.update(_within(range(int(first), int(last or first) + 1, int(step or 1)), count))
    if not found:
        raise UsageError(f"--scans {text}: the list has the scans 1 to {count}. [farm.range]")
    return sorted(found)


def _within(numbers: Iterable[int], count: int) -> Iterable[int]:
    for number in numbers:
        if not 1 <= number <= count:
            raise UsageError(f"--scans: {number} is none of the scans 1 to {count}. [farm.range]")
        yield number
