"""Which scans a farm converts: their list in a file, and a name for each that its folder gets."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from usdbrdf.capture.adapters import choose_adapter
from usdbrdf.errors import InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.documents import read_json, read_text
from usdbrdf.files.naming import unique_identifiers
from usdbrdf.job.versions import refuse_version
from usdbrdf.option import is_one_line

SCANS_FILE = "scans.json"
RESULTS_FOLDER = "results"
_SCHEMA = 1
_MAIN_FILE = "transforms.json"
_RANGE = re.compile(r"(\d{1,9})(?:-(\d{1,9})(?::([1-9]\d{0,8}))?)?")


@dataclass(frozen=True, kw_only=True)
class ScanList:
    """The scans of a bundle, numbered from 1 in this order.

    root    folder above all of them, where it was when the list was made
    names   of each: of its asset's folder, its page and its record
    places  of each, relative to ``root``
    retired names of scans that are no longer in it, and their places: the results may hold what
            they stood for
    """

    root: Path
    names: tuple[str, ...]
    places: tuple[str, ...]
    retired: tuple[tuple[str, Path], ...] = ()


def listed_in(file: Path) -> list[Path]:
    """The scans that a text file names, one a line, relative to its folder; lines that begin with
    "#" are comments.

    InputRefused for a file that cannot be read."""
    lines = (line.strip() for line in read_text(file).split("\n"))
    return [file.parent / line for line in lines if line and not line.startswith("#")]


def list_of(scans: Sequence[Path], known: Mapping[str, Path] | None = None) -> ScanList:
    """The list of these capture folders or main files, each once, with names that depend on their
    places alone and not on their order; a place that is ``known`` keeps its name, and no other gets
    it. UsageError where there are none, InputRefused where one is not there."""
    once: dict[str, Path] = {}
    for scan in scans:  # by links, too, as it was named first
        once.setdefault(os.path.realpath(scan), Path(os.path.abspath(scan)))
    places = [*once.values()]
    if not places:
        raise UsageError("no scans: name some, or a --list FILE that does. [farm.scans]")
    missing = [place for place in places if not place.exists()]
    if missing:
        more = f" (and {len(missing) - 1} others of the list)" if len(missing) > 1 else ""
        raise InputRefused(
            f"{missing[0]}: no such file or folder{more}. Correct the path; nothing was written. "
            "[farm.scan]"
        )
    places = [place for place in places if not _is_read_with_its_folder(place, once)]
    root = Path(os.path.commonpath([place.parent for place in places]))
    if not is_one_line(str(root)):
        raise InputRefused(
            f"{str(root)!r}: this folder above the scans has a line break or another control "
            "character in its name, which a farm's jobs cannot hold. Rename it; nothing was "
            "written. [farm.scan]"
        )
    return ScanList(
        root=root,
        names=tuple(_names(places, known or {})),
        places=tuple(place.relative_to(root).as_posix() for place in places),
    )


def _is_read_with_its_folder(scan: Path, once: Mapping[str, Path]) -> bool:
    """Whether a scan is the main file of a folder that is named too. Of another name it may be of
    other frames, and who has formats that come first reads the folder by these."""
    folder = Path(os.path.realpath(scan)).parent
    if scan.name != _MAIN_FILE or not scan.is_file() or str(folder) not in once:
        return False
    try:
        return choose_adapter(folder, plugins=False).name == "transforms"
    except InputRefused:
        return False


def _names(wanted: Sequence[Path], known: Mapping[str, Path]) -> list[str]:
    """A folder's name, a main file's behind that of its folder, with as many of the folders above
    as tell it from all others; identifiers, for they become names of files and prims."""
    names = {place: name for name, place in known.items()}
    places = [*dict.fromkeys([*wanted, *names])]
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
    new = (i for i, place in enumerate(places) if place not in names)
    in_order = sorted(new, key=lambda i: parts[i])
    found = unique_identifiers([labels[i] for i in in_order], fallback="scan", known=known)
    names |= dict(zip((places[i] for i in in_order), found, strict=True))
    return [names[place] for place in wanted]


def known_in(folder: Path) -> dict[str, Path]:
    """The names that stand for scans in a bundle, those of earlier lists first, and their places;
    none where there is no bundle yet. InputRefused for a list that is none."""
    file = folder / SCANS_FILE
    if not file.is_file():
        return {}
    scans = read_list(file)
    return dict(scans.retired) | _placed(scans)


def list_document(scans: ScanList, folder: Path) -> dict[str, Any]:
    """The list as the document of a bundle in ``folder``. OwnershipConflict where a name stands for
    another scan there, or did: the asset that has it would be taken for that scan's."""
    file, known, now = folder / SCANS_FILE, known_in(folder), _placed(scans)
    # Some file systems know no case.
    owners = {name.lower(): place for name, place in known.items()}
    for name, place in now.items():
        if (owner := owners.pop(name.lower(), place)) != place:
            raise OwnershipConflict(
                f"{file}: {name} is the scan {owner} here, not {place}. Choose another folder with "
                "-o. [farm.name]"
            )
    rows = [{"name": n, "place": p} for n, p in zip(scans.names, scans.places, strict=True)]
    retired = [{"name": n, "place": str(p)} for n, p in known.items() if n.lower() in owners]
    return {"schema": _SCHEMA, "root": str(scans.root), "scans": rows, "retired": retired}


def _placed(scans: ScanList) -> dict[str, Path]:
    return dict(zip(scans.names, (scans.root / place for place in scans.places), strict=True))


def read_list(file: Path) -> ScanList:
    """The list of a bundle, or InputRefused."""
    document = read_json(file)
    try:
        rows, left = document["scans"], document.get("retired", [])
        known = document["schema"] == _SCHEMA and isinstance(document["root"], str)
        names, places = (tuple(row[key] for row in rows) for key in ("name", "place"))
        retired = tuple((row["name"], Path(row["place"])) for row in left)
        used = [*names, *(name for name, _ in retired)]
        safe = all(re.fullmatch(r"\w{1,64}", name, re.ASCII) for name in used)
        safe &= len({name.lower() for name in used}) == len(used)
        safe &= all(isinstance(place, str) for place in places)
    except (AttributeError, KeyError, TypeError):
        known = safe = False
    if not (known and safe and rows):
        raise InputRefused(
            f"{file}: no list of scans that usdbrdf farm wrote. Write the bundle again. [farm.list]"
        )
    return ScanList(root=Path(document["root"]), names=names, places=places, retired=retired)


def refuse_nested(folder: Path, scans: ScanList) -> None:
    """UsageError for a bundle inside a scan, which every result would change, or a scan inside the
    bundle, where results are written, OwnershipConflict for one inside a published version; links
    are followed."""
    refuse_version(folder)
    bundle = folder.resolve()
    for place in _placed(scans).values():
        scan = place.resolve()
        if (bundle.is_relative_to(scan) and scan.is_dir()) or scan.is_relative_to(bundle):
            raise UsageError(
                f"{folder}: lies inside the scan {place}, or it inside the folder. Choose a folder "
                "beside the scans with -o. [farm.inside]"
            )


def refuse_results_inside(folder: Path, places: Iterable[Path]) -> None:
    """UsageError for results inside a scan, which each of them would change, OwnershipConflict for
    ones inside a published version; links are followed."""
    refuse_version(folder)
    results = folder.resolve()
    for place in places:
        scan = place.resolve()
        if results.is_relative_to(scan) and scan.is_dir():
            raise UsageError(
                f"--results {folder}: lies inside the scan {place}. Choose a folder beside the "
                "scans. [farm.inside]"
            )


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
