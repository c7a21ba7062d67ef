"""``manifest.json`` of a published version: what was published, and the SHA-256 of every file."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from usdbrdf.asset.layout import Asset
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.colour import WORKING_SPACE
from usdbrdf.files.documents import json_text, read_json, write_json
from usdbrdf.files.paths import files_below
from usdbrdf.job.stamp import check_relative
from usdbrdf.job.versions import MANIFEST

_SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """What one published version is.

    name, version   of the asset
    identifier      by which others find it: a path or a URI
    texture_space   of its colours and textures
    photographs     whether it holds any
    content         SHA-256 of all that it says, but for its version
    files           path in the folder -> SHA-256; all files but the manifest
    """

    name: str
    version: str
    identifier: str
    texture_space: str
    photographs: bool
    content: str
    files: Mapping[str, str] = field(default_factory=dict)


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write it, whole or not at all; its own hash is in it."""
    record = asdict(manifest)
    write_json(folder / MANIFEST, {"schema": _SCHEMA, "check": _hash_of(record), **record})


def read_manifest(folder: Path) -> Manifest:
    """InputRefused where it is missing, damaged or altered, or was written by a newer program."""
    file = folder / MANIFEST
    record = read_json(file)
    try:
        if record.pop("schema") != _SCHEMA:
            raise InputRefused(
                f"{file}: written by a newer usdbrdf. Install that version. [publish.manifest]"
            )
        if record.pop("check") != _hash_of(record):
            raise ValueError
        manifest = Manifest(**record)
        for path in manifest.files:
            check_relative(path)
    except InputRefused:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, UsdBrdfError) as error:
        raise InputRefused(
            f"{file}: this is not the manifest that was published. Bring it back from a copy. "
            "[publish.manifest]"
        ) from error
    return manifest


def refuse_converted(asset: Asset) -> None:
    """InputRefused for a published version whose colours are in another space than those that we
    measure in."""
    if not asset.is_published:
        return
    space = read_manifest(asset.folder).texture_space
    if space != WORKING_SPACE:
        raise InputRefused(
            f"{asset.folder}: published in {space}, for programs that render in it. Use the asset "
            "that it was published from, or a version without --texture-space. [publish.space]"
        )


def changes(folder: Path) -> Iterator[tuple[Path, str]]:
    """Files of a published version that are not what was published, and in what."""
    manifest = read_manifest(folder)
    for path, sha256 in manifest.files.items():
        file = folder / path
        if not file.is_file():
            yield file, "is missing"
        elif sha256_of(file) != sha256:
            yield file, "was changed"
    for file in files_below(folder, without=folder / MANIFEST):
        if file.relative_to(folder).as_posix() not in manifest.files:
            yield file, "was added"


def _hash_of(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_text(dict(record)).encode()).hexdigest()
