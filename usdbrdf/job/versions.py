"""Published versions: which folders are one, for nothing is written into them again."""

from __future__ import annotations

import os
import re
from pathlib import Path

from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.files.documents import read_json

# In each folder of a published version, and how these are called.
MANIFEST, VERSION = "manifest.json", re.compile(r"v(\d{3,9})")


def version_around(place: Path) -> Path | None:
    """The published version that a place is or lies in, whatever asset it is of; links are
    followed."""
    inner = place.resolve()
    return next((folder for folder in (inner, *inner.parents) if _is_version(folder)), None)


def refuse_version(place: Path) -> None:
    """OwnershipConflict for a place that is a published version or lies in one. Whoever writes asks
    this of each output that is named, before any work."""
    if (version := version_around(place)) is not None:
        which = "this" if version == place.resolve() else str(version)
        raise OwnershipConflict(
            f"{place}: {which} is a published version, which never changes. Name the asset that it "
            "was published from, or another place. [ownership.published]"
        )


def versions_in(folder: Path) -> list[str]:
    """Names of the versions in a folder, the latest last; it is judged by their names alone."""
    names = [entry.name for entry in folder.iterdir() if VERSION.fullmatch(entry.name)]
    return sorted(names, key=lambda name: int(name[1:]))


def _is_version(folder: Path) -> bool:
    """Whether its manifest has the entries of ours, for those of other programs are called so too;
    of one that is damaged the folder's name and its scan tell, of one that is lost the files."""
    manifest = folder / MANIFEST
    if not os.path.isfile(manifest):
        return _has_a_versions_files(folder)
    try:
        record = read_json(manifest)
    except InputRefused:
        return VERSION.fullmatch(folder.name) is not None and _has_a_scan(folder)
    return isinstance(record, dict) and {"schema", "check", "files"} <= record.keys()


def _has_a_versions_files(folder: Path) -> bool:
    """Whether there is a root layer as publishing writes it, and none that an asset has."""
    return _has_a_scan(folder) and any(folder.glob("*.usd")) and not any(folder.glob("*.usda"))


def _has_a_scan(folder: Path) -> bool:
    return os.path.isfile(folder / "layers" / "scan.usdc")
