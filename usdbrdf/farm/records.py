"""What a task leaves of each scan for the table of all: a small document, written anew by every run
that found something else."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json, write_json

Status = Literal["good", "invalid", "refused", "crashed", "defect", "unfinished", "begun"]
_SCHEMA = 1


@dataclass(frozen=True, kw_only=True)
class Record:
    """Of one scan.

    status    good; invalid: converted, and validate finds errors; refused: it, or its folder, needs
              a person; crashed: the process died of it again and again; defect: of usdbrdf;
              unfinished: for want of memory, disk or a free folder, trying again may help; begun:
              a task is at it, or died
    sentence  why it is not good, "" where it is
    objects, measured, warnings   how many
    seconds   of the run that converted it last, by the clock
    seal      hash of what page and findings were made from; "" where there is none
    begun     how many tasks have begun it since one ended
    """

    status: Status
    sentence: str = ""
    objects: int = 0
    measured: int = 0
    warnings: int = 0
    seconds: float = 0.0
    seal: str = ""
    begun: int = 0


@dataclass(frozen=True)
class Results:
    """Where what becomes of scans lies, by their names."""

    folder: Path

    def asset(self, name: str) -> Path:
        return self.folder / "assets" / name

    def page(self, name: str) -> Path:
        return self.folder / "pages" / f"{name}.html"

    def record(self, name: str) -> Path:
        return self.folder / "records" / f"{name}.json"

    @property
    def table(self) -> Path:
        return self.folder / "index.html"


def write_record(file: Path, record: Record) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    write_json(file, {"schema": _SCHEMA, **asdict(record)})


def read_record(file: Path) -> Record | None:
    """None where there is none, or none that can be read: the scan is then looked at again."""
    if not file.is_file():
        return None
    try:
        document = read_json(file)
        if document.pop("schema") != _SCHEMA or document["status"] not in get_args(Status):
            return None
        record = Record(**document)
        kinds = {name: type(value) for name, value in asdict(Record(status="good")).items()}
        sound = all(isinstance(getattr(record, name), kind) for name, kind in kinds.items())
    except (InputRefused, AttributeError, KeyError, TypeError):
        return None
    return record if sound else None
