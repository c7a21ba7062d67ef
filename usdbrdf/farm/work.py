"""The work of a task: its scans one after another, each converted, validated and reported.

What is done already is left alone, what can go on goes on. A scan that cannot be used keeps none
of the others waiting: its sentence goes into its record. The task fails only where trying again may
help, and a scan that takes the whole process down is left out after a few times.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from usdbrdf.asset.layout import Asset
from usdbrdf.errors import EnvironmentFailure, FolderBusy, UsdBrdfError
from usdbrdf.farm.records import Record, Results, Status, read_record, write_record
from usdbrdf.files.atomic import environment_failures, failure_of_machine
from usdbrdf.job.progress import printable, say, tell
from usdbrdf.job.stamp import STATE_FOLDER, code_version, hash_of_files
from usdbrdf.job.task import TaskResult
from usdbrdf.options import ConvertOptions, ReportOptions
from usdbrdf.page.report import report
from usdbrdf.pipeline import convert
from usdbrdf.run_table import statuses_of
from usdbrdf.validation.validate import has_errors, validate

# So many tasks die of a scan before it is left out: a machine that is taken away looks the same.
_MOST_BEGUN = 3
_RETRY = (EnvironmentFailure.exit_code, FolderBusy.exit_code)


@dataclass(frozen=True, kw_only=True)
class Work:
    """What all scans of a task have in common; options, wait and lock are those of ``convert``."""

    results: Results
    options: ConvertOptions
    adapter: str | None = None
    plugins: bool = True
    photographs: bool = True
    wait_s: float = 0.0
    without_lock: bool = False


def work_on(
    scans: Sequence[tuple[str, Path]], work: Work, told: Callable[[int, str], None]
) -> tuple[dict[str, Record], int]:
    """Do the work on each scan, by its name and place; ``told`` hears how many are done and a
    sentence, before and after each. Returns their records by name, and the task's exit code: 0, or
    that of the first scan for which trying again may help."""
    records, status = {}, 0
    for done, (name, place) in enumerate(scans):
        say(_line(f"scan {name}: {place}"))
        told(done, f"{name}: begun")
        record, code = _worked_on(name, place, work)
        if record.sentence:
            tell(_line(f"scan {name}: {record.status}: {record.sentence}"))
        told(done + 1, f"{name}: {record.status}")
        records[name] = record
        status = status or (code if code in _RETRY else 0)
    return records, status


def _worked_on(name: str, place: Path, work: Work) -> tuple[Record, int]:
    """What came of a scan, which its record tells too, and its exit code."""
    file = work.results.record(name)
    before = read_record(file) or Record(status="begun")
    if before.status == "begun" and before.begun >= _MOST_BEGUN:
        record, code = _crashed(before), 0
    else:
        begun = before.begun if before.status == "begun" else 0
        try:
            with environment_failures(str(file)):
                write_record(file, replace(before, status="begun", begun=begun + 1))
            record, code = _converted(name, place, work, before), 0
        except FolderBusy as error:
            record, code = _failed(before, str(error), error.exit_code), error.exit_code
            if before.status == "begun" and before.begun:
                # Of the task that is at it: what came of the scan is for that one to say.
                write_record(file, before)
                return record, code
        except UsdBrdfError as error:
            record, code = _failed(before, str(error), error.exit_code), error.exit_code
        except MemoryError:
            sentence = "out of memory. Give tasks larger machines (--ram). [environment.memory]"
            code = EnvironmentFailure.exit_code
            record = _failed(before, sentence, code)
        except Exception as error:
            sentence, code = _unexpected(error)
            record = _failed(before, sentence, code)
        except BaseException:  # stopped from outside, which is none of its tries
            write_record(file, replace(before, status="begun", begun=begun))
            raise
    with environment_failures(str(file)):
        write_record(file, record)
    return record, code


def _unexpected(error: Exception) -> tuple[str, int]:
    """What is said of an error that nobody expected, and its exit code."""
    if (failure := failure_of_machine(error)) is not None:
        return str(failure), failure.exit_code
    tell("".join(traceback.format_exception(error)).rstrip())
    return f"a defect of usdbrdf ({type(error).__name__}). Report it. [farm.defect]", 1


def _crashed(before: Record) -> Record:
    sentence = (
        f"{before.begun} tasks died while they worked on it. Convert it alone to see why; the next "
        "run of the job tries it again. [farm.crashed]"
    )
    return Record(status="crashed", sentence=sentence)


def _failed(before: Record, sentence: str, code: int) -> Record:
    status: Status = "unfinished" if code in _RETRY else "defect" if code == 1 else "refused"
    return Record(status=status, sentence=sentence, seconds=before.seconds)


def _converted(name: str, place: Path, work: Work, before: Record) -> Record:
    """All of it; validation and page only where something changed since they were made."""
    folder, start = work.results.asset(name), time.monotonic()
    steps = convert(
        place, folder, work.options, adapter=work.adapter, plugins=work.plugins,
        wait_s=work.wait_s, without_lock=work.without_lock,
    )  # fmt: skip
    asset, page = Asset.at(folder), work.results.page(name)
    seal = _seal(asset, work.photographs)
    if seal == before.seal and page.is_file():
        say(f"scan {name}: up to date")
        return replace(before, status="good" if not before.sentence else "invalid", begun=0)
    errors = [str(finding) for finding in validate(asset.root_layer) if has_errors([finding])]
    environment = work.options.shade.environment
    report(folder, page, ReportOptions(environment=environment, photographs=work.photographs))
    return Record(
        status="invalid" if errors else "good",
        sentence=f"validate found {len(errors)} errors, the first: {errors[0]}" if errors else "",
        **_counts(steps),
        seconds=round(time.monotonic() - start, 1),
        seal=seal,
    )


def _counts(steps: dict[str, TaskResult]) -> dict[str, int]:
    """Objects, how many of them are measured, and warnings."""
    summaries = {step: result.summary for step, result in steps.items()}
    statuses = [*statuses_of(summaries).values()]
    return {
        "objects": len(statuses),
        "measured": statuses.count("measured"),
        "warnings": sum(len(summary.get("warnings", ())) for summary in summaries.values()),
    }


def _seal(asset: Asset, photographs: bool) -> str:
    """Of the stamps, and so of all that the steps wrote; of people's layers; of the version that
    makes page and findings, and of what the page shows."""
    stamps = (asset.folder / STATE_FOLDER / "stamps").glob("*.json")
    files = sorted([*stamps, *asset.folder.glob("*.usda")])
    shown = "with" if photographs else "without"
    return f"{code_version()} {shown} photographs {hash_of_files(files, asset.folder)}"


def _line(text: str) -> str:
    """The text in one line: a second could begin with a word that OpenJD obeys."""
    return " ".join(text.split())


def openjd_lines(sentence: str, share: float | None = None) -> str:
    """What an OpenJD session takes out of a task's output: a sentence about what it does, and the
    share of its scans, 0 to 1, that is done."""
    said = f"openjd_status: {_line(printable(sentence))}"
    return said if share is None else f"openjd_progress: {100 * share:.1f}\n{said}"
