"""What came of all scans of a bundle, as a table and as one number for whether all are good."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import read_manifest
from usdbrdf.errors import InputRefused
from usdbrdf.farm.records import Record, Results, read_record
from usdbrdf.farm.scans import ScanList
from usdbrdf.job.stamp import missing_of

# How a table calls them, and what the whole comes to: the first of these that some scan has. Trying
# again may help one that nobody began, or that was left; then what a defect is; then the rest.
_EXIT_CODES = {
    "waiting": 4, "begun": 4, "unfinished": 4, "crashed": 1, "defect": 1, "refused": 3,
    "invalid": 7, "good": 0,
}  # fmt: skip
_STATUSES = ("good", "invalid", "refused", "crashed", "defect", "unfinished", "begun", "waiting")


@dataclass(frozen=True, kw_only=True)
class Row:
    """One scan: its record, or "waiting" where no task has come to it; ``page``: of its report,
    relative to the results, "" where there is none."""

    name: str
    scan: str
    status: str
    sentence: str
    objects: int
    measured: int
    warnings: int
    seconds: float
    page: str


def rows_of(scans: ScanList, results: Results) -> list[Row]:
    """One row for each scan, in the order of the list."""
    return [
        _row(name, place, results) for name, place in zip(scans.names, scans.places, strict=True)
    ]


def _row(name: str, place: str, results: Results) -> Row:
    found = read_record(results.record(name))
    record, page = found or Record(status="begun"), results.page(name)
    if record.status in ("good", "invalid"):
        record = _while_it_is_there(record, results.asset(name))
    told = record.status in ("good", "invalid") and page.is_file()
    return Row(
        name=name,
        scan=place,
        status=record.status if found else "waiting",
        sentence=record.sentence,
        objects=record.objects,
        measured=record.measured,
        warnings=record.warnings,
        seconds=record.seconds,
        page=page.relative_to(results.folder).as_posix() if told else "",
    )


def _while_it_is_there(record: Record, folder: Path) -> Record:
    """The record of a scan that was converted, or that of one that is to be again: its asset may
    have been deleted since, or a part of it. A published version may have taken its place; and it
    is whole without what tells of photographs."""
    asset = Asset.at(folder)
    if asset.is_published:
        try:
            files = read_manifest(folder).files
        except InputRefused as refused:
            return Record(status="unfinished", sentence=str(refused))
        missing = next((name for name in files if not (folder / name).is_file()), None)
        cure = ". Bring it back from a copy"
    else:
        photographs = asset.photographs_layer.relative_to(asset.folder).as_posix()
        missing = missing_of(folder, spared=photographs)
        cure = "; the next run of the job makes it again"
    if missing is None:
        return record
    sentence = f"{folder / missing}: is gone{cure}. [farm.asset]"
    return Record(status="unfinished", sentence=sentence)


def exit_code(rows: Sequence[Row]) -> int:
    """0 where all are good; else 4 where trying again may help, 1 after a defect or a crash, 3
    where a scan was refused, 7 where an asset has errors: the first of these that holds."""
    found = {row.status for row in rows}
    return next(code for status, code in _EXIT_CODES.items() if status in found)


def counted(rows: Sequence[Row]) -> str:
    """ "40 scans: 37 good, 3 refused"."""
    found = [row.status for row in rows]
    counts = ", ".join(f"{found.count(s)} {s}" for s in _STATUSES if s in found)
    return f"{len(rows)} scan{'s' * (len(rows) != 1)}: {counts}"


def table_lines(rows: Sequence[Row]) -> Iterator[str]:
    """The table in text, good scans with their figures, others with their sentence. Lines begin
    with blanks: OpenJD obeys those that begin with words of its own, and scans may be called so."""
    wide = max(len(row.name) for row in rows)
    yield f"  {'scan':{wide}}  {'status':10}  measured  warnings     time"
    for row in rows:
        start = f"  {row.name:{wide}}  {row.status:10}"
        if row.status in ("good", "invalid"):
            measured = f"{row.measured} of {row.objects}"
            start += f"  {measured:>8}  {row.warnings:>8}  {time_told(row.seconds):>7}"
        yield f"{start}  {' '.join(row.sentence.split())}".rstrip()


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """The same for programs."""
    return {
        "scans": [asdict(row) for row in rows],
        "counts": {s: n for s in _STATUSES if (n := sum(row.status == s for row in rows))},
        "objects": sum(row.objects for row in rows),
        "measured": sum(row.measured for row in rows),
        "seconds": round(sum(row.seconds for row in rows), 1),
    }


def time_told(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.1f} min"
