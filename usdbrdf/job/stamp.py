"""The record of a finished task, and why a task has to run (again).

A task is done if and only if its stamp can be read and is intact, its schema is known, version,
code, parameters and inputs are equal, and every output is there with the hash in the stamp. Times
play no part: touching a file changes nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.documents import json_text, read_json, write_json
from usdbrdf.identity import tasks_identity

STATE_FOLDER = ".usdbrdf"
STAMP_SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """What a task did.

    stage                its name
    version, code        of the package, and the hash of its sources
    parameters, inputs   what it depends on; inputs maps a label to a SHA-256
    outputs              asset-relative path -> SHA-256
    once                 paths created where absent and the artist's from then on: no hash
    summary              what the task's work returned
    earlier              only in the journal of a publish: path -> hashes that it may replace
    """

    stage: str
    version: str
    parameters: dict[str, Any]
    inputs: dict[str, str]
    outputs: dict[str, str] = field(default_factory=dict)
    once: list[str] = field(default_factory=list)
    summary: dict[str, Any] = field(default_factory=dict)
    code: str = ""
    earlier: dict[str, list[str]] = field(default_factory=dict)

    @property
    def fingerprint(self) -> str:
        """12 hexadecimal digits of all that the outputs depend on."""
        cause = [self.stage, self.version, self.code, self.parameters, self.inputs]
        return hashlib.sha256(json_text(cause).encode()).hexdigest()[:12]


def stamp_of(name: str, parameters: Mapping[str, Any], inputs: Mapping[str, str]) -> Stamp:
    """The stamp of a task that has not run yet, its parameters as JSON gives them back."""
    plain = json.loads(json_text(dict(parameters)))
    return Stamp(
        stage=name,
        version=code_version(),
        code=tasks_identity(),
        parameters=plain,
        inputs=dict(inputs),
    )


def stamp_path(asset: Path, order: int, name: str) -> Path:
    """Where the stamp of a task lies."""
    return asset / STATE_FOLDER / "stamps" / f"{order}-{name}.json"


def journal_path(asset: Path, name: str) -> Path:
    """Where a task notes what it is about to publish, while it does."""
    return asset / STATE_FOLDER / f"publishing-{name}.json"


def read_stamp(path: Path) -> Stamp | None:
    """A stamp or journal; None if absent, damaged, altered or of a schema that we do not know."""
    try:
        record = read_json(path)
        if record.pop("schema") != STAMP_SCHEMA or record.pop("check") != _check(record):
            return None
        stamp = Stamp(**record)
        for relative in (*stamp.outputs, *stamp.once, *stamp.earlier):
            check_relative(relative)
    except (InputRefused, UsdBrdfError, AttributeError, KeyError, TypeError):
        return None
    return stamp


def write_stamp(path: Path, stamp: Stamp) -> None:
    """Write a stamp or journal, whole or not at all."""
    record = asdict(stamp)
    write_json(path, {"schema": STAMP_SCHEMA, "check": _check(record), **record})


def why_rerun(asset: Path, order: int, wanted: Stamp) -> str | None:
    """The reason why a task has to run, in words, or None if it is done."""
    stamp = read_stamp(stamp_path(asset, order, wanted.stage))
    if stamp is None:
        return "not done before"
    if stamp.version != wanted.version:
        return f"version {wanted.version} instead of {stamp.version}"
    if stamp.code != wanted.code:
        return "code changed"
    for kind in ("parameters", "inputs"):
        names = _differing(getattr(stamp, kind), getattr(wanted, kind))
        if names:
            return f"{kind} changed: {', '.join(names)}"
    for relative, expected in stamp.outputs.items():
        file = asset / relative
        if not file.is_file():
            return f"output missing: {relative}"
        if sha256_of(file) != expected:
            return f"output changed: {relative}"
    missing = [relative for relative in stamp.once if not (asset / relative).is_file()]
    return f"output missing: {missing[0]}" if missing else None


def known_hashes(state_folder: Path) -> dict[str, set[str]]:
    """Every hash that stamps and journals give for a published file, by asset-relative path."""
    paths = [*state_folder.glob("stamps/*.json"), *state_folder.glob("publishing-*.json")]
    return hashes_in(map(read_stamp, paths))


def hashes_in(stamps: Iterable[Stamp | None]) -> dict[str, set[str]]:
    """The hashes that these stamps and journals give, by asset-relative path."""
    known: dict[str, set[str]] = {}
    for stamp in filter(None, stamps):
        for relative, sha256 in stamp.outputs.items():
            known.setdefault(relative, set()).add(sha256)
        for relative, hashes in stamp.earlier.items():
            known.setdefault(relative, set()).update(hashes)
    return known


def check_relative(relative: str) -> str:
    """The path itself, if it stays in the asset folder and out of our own state folder."""
    path = PurePosixPath(relative)
    if path.is_absolute() or ".." in path.parts or path.parts[:1] in ((), (STATE_FOLDER,)):
        raise UsdBrdfError(f"{relative!r} is not a path inside the asset. [task.output]")
    return path.as_posix()


@cache
def code_version() -> str:
    """Version of the installed package, as layers tell it; a plain checkout has none."""
    try:
        return version("usdbrdf")
    except PackageNotFoundError:
        return "0+checkout"


def _check(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json_text(record).encode()).hexdigest()


def _differing(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    missing = object()
    return sorted(key for key in {*old, *new} if old.get(key, missing) != new.get(key, missing))
