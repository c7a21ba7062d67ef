"""The commands for many scans: a job bundle, what its tasks do, and the table of all."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from usdbrdf.command_kinds import Locking, OnCapture, Talking
from usdbrdf.errors import UsageError
from usdbrdf.farm.options import FarmOptions
from usdbrdf.job.interrupts import loading
from usdbrdf.job.progress import printable, show, tell_lines_to
from usdbrdf.option import REQUIRED, option
from usdbrdf.options import ConvertOptions

if TYPE_CHECKING:
    from usdbrdf.farm.records import Results
    from usdbrdf.farm.scans import ScanList


class Farm(OnCapture, Locking):
    """Write a job bundle (Open Job Description) that converts many scans on a farm."""

    scans: tuple[Path, ...] = option("SCAN", ())
    "capture folders or their main files"
    list_file: Path | None = option("--list FILE", None, file=True)
    """text file that names scans, one a line, relative to its folder; lines that begin with "#" are
    comments"""
    output: Path = option("-o --output DIR", REQUIRED, one_line=True)
    "folder of the bundle, made if it is not there; the job's results go into it too"
    farm: FarmOptions
    options: ConvertOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.farm.bundle import TEMPLATE, bundle_of, write_bundle
            from usdbrdf.farm.scans import known_in, list_of, listed_in, refuse_nested
        listed = listed_in(self.list_file) if self.list_file is not None else []
        scans = list_of([*self.scans, *listed], known_in(self.output))
        refuse_nested(self.output, scans)
        made = bundle_of(
            self.output.absolute().name, scans, self.options, self.farm, self.adapter,
            plugins=self.plugins, wait_s=self.wait_s, without_lock=self.without_lock,
        )  # fmt: skip
        write_bundle(self.output, scans, made)
        template = self.output / TEMPLATE
        tasks = -(-len(scans.names) // self.farm.chunk)
        here = ["openjd", "run", str(template), "--step", "Table", "--run-dependencies"]
        for name, value in made.values.items():
            here += ["-p", f"{name}={value}"] if name != "ScanRoot" else []
        counts = (len(scans.names), "scan"), (tasks, "task")
        told = " in ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts)
        cloud = ["deadline", "bundle", "submit", str(self.output)]
        return self.told(
            {"template": str(template), "tasks": tasks, "scans": [*scans.names]},
            f"{template}: written, {told}",
            f"here:           {shlex.join(here)}",
            f"Deadline Cloud: {shlex.join(cloud)}",
        )


class _InBundle(Talking):
    bundle: Path = option("BUNDLE", REQUIRED, one_line=True)
    "folder that usdbrdf farm wrote, or its scans.json in any place"
    results: Path | None = option(
        "--results DIR", None, unset="results, beside the list", one_line=True
    )
    "folder of assets, pages and records, made if it is not there"

    def list_and_results(self) -> tuple[ScanList, Results]:
        from usdbrdf.farm.records import Results
        from usdbrdf.farm.scans import RESULTS_FOLDER, SCANS_FILE, read_list

        file = self.bundle / SCANS_FILE if self.bundle.is_dir() else self.bundle
        results = Results((self.results or file.parent / RESULTS_FOLDER).absolute())
        return read_list(file), results


class FarmWork(OnCapture, Locking, _InBundle):
    """Convert, validate and report scans of a bundle, as its tasks do."""

    root: Path | None = option(
        "--root DIR", None, unset="as when the list was written", empty=True, one_line=True
    )
    "folder above all scans"
    chosen: str | None = option("--scans RANGE", None, unset="all")
    "their numbers in the list, such as 3 or 1-5,8"
    openjd: bool = option("--openjd", False)
    "tell progress in the lines that a session of OpenJD listens for"
    photographs: bool = option("--no-photographs", True)
    "leave photographs out of the pages"
    options: ConvertOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.farm.scans import numbers_in, refuse_results_inside
            from usdbrdf.farm.work import Work, openjd_lines, work_on
        scans, results = self.list_and_results()
        count = len(scans.names)
        numbers = numbers_in(self.chosen, count) if self.chosen else [*range(1, count + 1)]
        if self.openjd and self.json:
            raise UsageError("--openjd, --json: they exclude each other. [usage.option]")

        def told(done: int, sentence: str) -> None:
            if self.openjd:
                show(openjd_lines(sentence, done / len(numbers)))

        if self.openjd:
            tell_lines_to(lambda line: show(openjd_lines(line)))
        work = Work(
            results=results, options=self.options, adapter=self.adapter, plugins=self.plugins,
            photographs=self.photographs, wait_s=self.wait_s, without_lock=self.without_lock,
        )  # fmt: skip
        root = scans.root if self.root is None else self.root.absolute()
        chosen = [(scans.names[n - 1], root / scans.places[n - 1]) for n in numbers]
        refuse_results_inside(results.folder, [place for _, place in chosen])
        try:
            records, status = work_on(chosen, work, told)
        finally:
            tell_lines_to(None)
        self.told({"scans": {name: asdict(record) for name, record in records.items()}})
        return status


class FarmTable(_InBundle):
    """Say what came of all scans of a bundle, and write the page over them."""

    def run(self) -> int:
        with loading():
            from usdbrdf.farm.page import page_of
            from usdbrdf.farm.scans import refuse_results_inside
            from usdbrdf.farm.table import counted, exit_code, rows_of, summary, table_lines
            from usdbrdf.files.atomic import environment_failures, write_text_atomic
        scans, results = self.list_and_results()
        refuse_results_inside(results.folder, [scans.root / place for place in scans.places])
        rows = rows_of(scans, results)
        with environment_failures(str(results.table)):
            results.folder.mkdir(parents=True, exist_ok=True)
            write_text_atomic(results.table, page_of(rows, self.title()))
        if self.json:
            show(json.dumps({"page": str(results.table), **summary(rows)}, indent=2), whole=True)
        else:
            show("\n".join(printable(line) for line in (*table_lines(rows), counted(rows))))
        return exit_code(rows)

    def title(self) -> str:
        place = self.bundle.absolute()
        return place.name if place.is_dir() else place.parent.name
