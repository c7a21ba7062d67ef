"""The record of a finished task, and why a task has to run (again).

A task is done if and only if its stamp can be read and is intact, its schema is known, version,
code, parameters and inputs are equal, and every output is there with the hash in the stamp. Times
play no part: touching a file changes nothing.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import environment_failures, sha256_of
from usdbrdf.files.documents import json_text, read_json, write_json
from usdbrdf.identity import tasks_identity


def hash_of_files(
    files: Iterable[Path], root: Path | None = None, each: dict[Path, str] | None = None
) -> str:
    """One SHA-256 over names (relative to ``root``, if given) and contents of many files, wherever
    they lie, in the order in which they come; InputRefused where one is missing.

    each  is told the SHA-256 of every file
    """
    names = list(files)
    for name in names:
        if not name.is_file():
            raise InputRefused(
                f"{name}: this file, which was there at ingest, is missing. Run `usdbrdf convert` "
                "with the capture again, from where it lies now. [input.missing]"
            )
    with environment_failures("reading the inputs"), ThreadPoolExecutor() as pool:
        digests = list(pool.map(sha256_of, names))
    if each is not None:
        each.update(zip(names, digests, strict=True))
    lines = [
        f"{name.relative_to(root).as_posix() if root else name.name}\0{digest}\n"
        for name, digest in zip(names, digests, strict=True)
    ]
    return hashlib.sha256("".join(lines).encode(errors="surrogateescape")).hexdigest()


STATE_FOLDER = ".usdbrdf"
STAMP_SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Stamp:
    """What a task did.

    stage                the task's name
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
        return _sha256_of_json(cause)[:12]


def stamp_of(name: str, parameters: Mapping[str, Any], inputs: Mapping[str, str]) -> Stamp:
    """The stamp of a task that has not run yet, its parameters as JSON gives them back."""
    return Stamp(
        stage=name,
        version=code_version(),
        code=tasks_identity(),
        parameters=json.loads(json_text(dict(parameters))),
        inputs=dict(inputs),
    )


def name_in_lighting(name: str, lighting: str) -> str:
    """What a task is called that is done for one of several lightings; its name where "" is."""
    return f"{name}@{lighting}" if lighting else name


def stamp_path(asset: Path, order: int, name: str) -> Path:
    return asset / STATE_FOLDER / "stamps" / f"{order}-{name}.json"


def journal_path(asset: Path, name: str) -> Path:
    """Where a task notes what it is about to publish, while it does."""
    return asset / STATE_FOLDER / f"publishing-{name}.json"


def read_stamp(path: Path) -> Stamp | None:
    """A stamp or journal; None if absent, damaged, altered or of a schema that we do not know."""
    try:
        record = read_json(path)
        if record.pop("schema") != STAMP_SCHEMA or record.pop("check") != _sha256_of_json(record):
            return None
        stamp = Stamp(**record)
        if not _is_of_its_types(stamp):
            return None
        for relative in (*stamp.outputs, *stamp.once, *stamp.earlier):
            check_relative(relative)
    except (InputRefused, UsdBrdfError, AttributeError, KeyError, TypeError):
        return None
    return stamp


def _is_of_its_types(stamp: Stamp) -> bool:
    """Whether its values are what ``Stamp`` says: anybody can reckon the hash of a record."""
    texts = stamp.stage, stamp.version, stamp.code, *stamp.once
    tables = stamp.parameters, stamp.inputs, stamp.outputs, stamp.summary, stamp.earlier
    if not (isinstance(stamp.once, list) and all(isinstance(table, dict) for table in tables)):
        return False
    texts += *stamp.inputs.values(), *stamp.outputs.values()
    lists = stamp.earlier.values()
    return all(isinstance(text, str) for text in texts) and all(
        isinstance(each, list) and all(isinstance(text, str) for text in each) for each in lists
    )


def write_stamp(path: Path, stamp: Stamp) -> None:
    """Write a stamp or journal, whole or not at all."""
    record = asdict(stamp)
    write_json(path, {"schema": STAMP_SCHEMA, "check": _sha256_of_json(record), **record})


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
        old, new = getattr(stamp, kind), getattr(wanted, kind)
        names = sorted(key for key in {*old, *new} if old.get(key, ...) != new.get(key, ...))
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


def missing_of(asset: Path, *, spared: str = "") -> str | None:
    """The first file that stamps tell of and that is not there, but for the one that is ``spared``,
    or the folder of stamps where that has none; what is in the files is not looked at."""
    stamps = [*filter(None, map(read_stamp, sorted((asset / STATE_FOLDER).glob("stamps/*.json"))))]
    if not stamps:
        return f"{STATE_FOLDER}/stamps"
    names = (name for stamp in stamps for name in (*stamp.outputs, *stamp.once))
    return next((n for n in names if n != spared and not (asset / n).is_file()), None)


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


def _sha256_of_json(record: object) -> str:
    return hashlib.sha256(json_text(record).encode()).hexdigest()
