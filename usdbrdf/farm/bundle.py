"""A job bundle of Open Job Description, as Deadline Cloud and others take it: one task for each
chunk of scans, and after them the table of all.

template.json        what is done (jobtemplate-2023-09, extension TASK_CHUNKING)
parameter_values     what its parameters are here, in Deadline Cloud's form
asset_references     which files it needs
scans.json           the scans (``farm.scans``), which the tasks number from 1

A task fails (and farms try it again) only where that may help: exit code 4 or 5. A scan that is
refused is written into its record, and its task is done.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from filecmp import cmp
from pathlib import Path
from typing import Any

from usdbrdf.errors import OwnershipConflict, UsageError
from usdbrdf.farm.options import FarmOptions
from usdbrdf.farm.scans import RESULTS_FOLDER, SCANS_FILE, ScanList, list_document
from usdbrdf.files.atomic import (
    environment_failures,
    flush_folder,
    folders_above,
    is_bare,
    move,
    temporary_folder,
)
from usdbrdf.files.documents import write_json
from usdbrdf.option import Option, OptionField, Options, option_fields
from usdbrdf.options import ConvertOptions

TEMPLATE, VALUES, REFERENCES = "template.json", "parameter_values.json", "asset_references.json"
_WORK, _TABLE = "Convert", "Table"
# What a task does with a signal is to stop at its last checkpoint.
_SECONDS_TO_STOP = 60
_LONGEST_NAME = 64  # of a job, for people
_MAX_PARAMETERS = 50  # of a template


@dataclass(frozen=True, kw_only=True)
class Bundle:
    """The documents of a bundle; ``values`` are those of parameters without a default that holds
    everywhere, as ``openjd run -p NAME=VALUE`` takes them too."""

    template: dict[str, Any]
    values: dict[str, str]
    references: dict[str, Any]


def bundle_of(
    name: str,
    scans: ScanList,
    convert: ConvertOptions,
    farm: FarmOptions,
    adapter: str | None = None,
    *,
    plugins: bool = True,
    wait_s: float = 0.0,
    without_lock: bool = False,
) -> Bundle:
    """The documents of the job that converts ``scans``.

    What was given of ``convert`` becomes parameters of the job, which whoever submits it may
    change; what was not is the default of the version of usdbrdf that the workers have.

    UsageError: the options make more parameters than a job may have.
    """
    words, parameters, values = _handed_through(convert)
    if adapter is not None:
        words.append(_word("--adapter", "Adapter"))
        parameters.append(_text_parameter("Adapter", "--adapter", adapter))
    if not plugins:
        words.append("--no-plugins")
    if not farm.photographs:
        words.append("--no-photographs")
    if wait_s:
        words.append(f"--wait={wait_s:g}")
    if without_lock:
        words.append("--without-lock")
    if _word("--memory", "Memory") not in words and farm.ram is not None:
        words.append(f"--memory={0.75 * farm.ram:g}")
    definitions = [*_own_parameters(farm), *parameters]
    if len(definitions) > _MAX_PARAMETERS:
        raise UsageError(
            f"{len(definitions)} options: a job has at most {_MAX_PARAMETERS} parameters. Leave "
            "those out that are the default. [farm.parameters]"
        )
    template = {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": _job_name(name, len(scans.names)),
        "parameterDefinitions": definitions,
        "steps": [_work_step(len(scans.names), farm, words), _table_step()],
    }
    own = {"ScanRoot": str(scans.root)}
    return Bundle(template=template, values=own | values, references=_references(scans))


def write_bundle(folder: Path, scans: ScanList, bundle: Bundle) -> None:
    """Write the documents into ``folder``, made if it is not there, all of them or none: only a
    folder with a template is a bundle. OwnershipConflict where it holds what is no bundle of ours.
    """
    with environment_failures(str(folder)):
        if os.path.lexists(folder) and not folder.is_dir():
            raise OwnershipConflict(
                f"{folder}: a file, or a link that leads nowhere, has this name. Choose another. "
                "[farm.folder]"
            )
        if folder.is_dir() and not is_bare(folder) and not (folder / SCANS_FILE).is_file():
            raise OwnershipConflict(
                f"{folder}: holds files, and no bundle of usdbrdf farm. Choose a new folder. "
                "[farm.folder]"
            )
        given = [{"name": name, "value": value} for name, value in sorted(bundle.values.items())]
        documents = {
            SCANS_FILE: list_document(scans, folder),
            VALUES: {"parameterValues": given},
            REFERENCES: bundle.references,
            TEMPLATE: bundle.template,
        }
        with folders_above(folder / TEMPLATE), temporary_folder(folder / TEMPLATE) as staged:
            for name, document in documents.items():
                write_json(staged / name, document)
            changed = [name for name in documents if not _are_same(staged / name, folder / name)]
            if changed:
                # That of an earlier list goes before the list does, and the new one comes last.
                (folder / TEMPLATE).unlink(missing_ok=True)
            for name in dict.fromkeys([*changed, TEMPLATE] if changed else ()):
                flush_folder(folder)
                move(staged / name, folder / name)
            flush_folder(folder)


def _are_same(one: Path, other: Path) -> bool:
    return other.is_file() and cmp(one, other, shallow=False)


def _job_name(name: str, count: int) -> str:
    """Without braces, in which a template would look for parameters."""
    plain = "".join(c for c in name if c.isprintable() and c not in "{}")[:_LONGEST_NAME]
    return f"usdbrdf {plain or 'scans'} ({count} scan{'s' * (count != 1)})"


def _own_parameters(farm: FarmOptions) -> list[dict[str, Any]]:
    def shown(label: str, control: str) -> dict[str, str]:
        return {"label": label, "control": control, "groupLabel": "Scans"}

    return [
        {
            "name": "Scans", "type": "PATH", "objectType": "FILE", "dataFlow": "IN",
            "default": SCANS_FILE, "userInterface": shown("List of scans", "CHOOSE_INPUT_FILE"),
            "description": "The list that usdbrdf farm wrote.",
        },
        {
            "name": "ScanRoot", "type": "PATH", "objectType": "DIRECTORY", "dataFlow": "NONE",
            "default": "", "userInterface": shown("Folder above all scans", "CHOOSE_DIRECTORY"),
            "description": "Where the places in the list begin; empty: where they did when it was "
            "written. Path mapping applies.",
        },
        {
            "name": "Results", "type": "PATH", "objectType": "DIRECTORY", "dataFlow": "OUT",
            "default": RESULTS_FOLDER, "userInterface": shown("Results", "CHOOSE_DIRECTORY"),
            "description": "Assets, pages, records and the page over all; what is done in it is "
            "kept.",
        },
        {
            "name": "ScansPerTask", "type": "INT", "default": farm.chunk, "minValue": 1,
            "userInterface": shown("Scans per task", "SPIN_BOX"),
            "description": "A task converts so many, one after another.",
        },
    ]  # fmt: skip


def _work_step(count: int, farm: FarmOptions, words: Sequence[str]) -> dict[str, Any]:
    chunks = {"defaultTaskCount": "{{Param.ScansPerTask}}", "rangeConstraint": "CONTIGUOUS"}
    definition = {"name": "Scan", "type": "CHUNK[INT]", "range": f"1-{count}", "chunks": chunks}
    amounts = []
    if farm.cores is not None:
        amounts.append({"name": "amount.worker.vcpu", "min": farm.cores})
    if farm.ram is not None:
        amounts.append({"name": "amount.worker.memory", "min": math.ceil(1024 * farm.ram)})
    chosen = ("--root", "{{Param.ScanRoot}}", "--scans", "{{Task.Param.Scan}}")
    system = {"name": "attr.worker.os.family", "anyOf": ["linux"]}
    return {
        "name": _WORK,
        "parameterSpace": {"taskParameterDefinitions": [definition]},
        "hostRequirements": {"attributes": [system], **({"amounts": amounts} if amounts else {})},
        "script": _script("farm-work", *chosen, "--openjd", *words),
    }


def _table_step() -> dict[str, Any]:
    return {"name": _TABLE, "dependencies": [{"dependsOn": _WORK}], "script": _script("farm-table")}


def _script(command: str, *words: str) -> dict[str, Any]:
    places = ["{{Param.Scans}}", "--results", "{{Param.Results}}"]
    cancelation = {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": _SECONDS_TO_STOP}
    run = {"command": "usdbrdf", "args": [command, *places, *words], "cancelation": cancelation}
    return {"actions": {"onRun": run}}


def _references(scans: ScanList) -> dict[str, Any]:
    """Scans as whole folders: a main file names others beside it."""
    places = [scans.root / place for place in scans.places]
    folders = sorted({str(place if place.is_dir() else place.parent) for place in places})
    return {
        "assetReferences": {
            "inputs": {"directories": folders, "filenames": []},
            "outputs": {"directories": []},
            "referencedPaths": [],
        }
    }


def _handed_through(
    convert: ConvertOptions,
) -> tuple[list[str], list[dict[str, Any]], dict[str, str]]:
    """Of what was given of ``convert``: the words of the command line, with references to
    parameters in the place of their values; these parameters; and the values of paths, whose
    defaults would have to lie in the bundle."""
    words: list[str] = []
    parameters: list[dict[str, Any]] = []
    values: dict[str, str] = {}
    for field, option, value in _given(convert, type(convert)()):
        if isinstance(value, bool):  # a flag says the opposite of the default
            words.append(option.name)
            continue
        several = value if isinstance(value, tuple) else (value,)
        for number, one in enumerate(several, 1):
            base = "".join(part.capitalize() for part in option.name.strip("-").split("-"))
            name = base if number == 1 else f"{base}{number}"
            words.append(_word(option.name, name))
            parameters.append(_parameter(name, field, option, one))
            if isinstance(one, Path):
                values[name] = str(one.absolute())
    return words, parameters, values


def _word(option: str, parameter: str) -> str:
    """An option with a parameter's value: one word, in which the value may begin with a dash."""
    return f"{option}={{{{Param.{parameter}}}}}"


def _given(
    options: Options, defaults: Options, told: set[str] | None = None
) -> Iterator[tuple[OptionField, Option, Any]]:
    """What differs from the defaults, options that several classes share once."""
    told = set() if told is None else told
    for field in option_fields(type(options)):
        value, default = getattr(options, field.name), getattr(defaults, field.name)
        if field.option is None:
            yield from _given(value, default, told)
        elif value != default and field.option.name not in told:
            told.add(field.option.name)
            yield field, field.option, value


def _parameter(name: str, field: OptionField, option: Option, value: Any) -> dict[str, Any]:
    if isinstance(value, Path):
        folder = value.is_dir()
        return {
            "name": name, "type": "PATH", "objectType": "DIRECTORY" if folder else "FILE",
            "dataFlow": "IN", "description": _about(option),
            "userInterface": _shown(option, "CHOOSE_DIRECTORY" if folder else "CHOOSE_INPUT_FILE"),
        }  # fmt: skip
    if isinstance(value, str):
        return _text_parameter(name, option.name, value, field.choices or option.words)
    low, high = option.limits
    shown = _shown(option, "SPIN_BOX") | ({} if field.kind is int else {"decimals": 6})
    return {
        "name": name, "type": "INT" if field.kind is int else "FLOAT", "default": value,
        **({"minValue": low} if math.isfinite(low) else {}),
        **({"maxValue": high} if math.isfinite(high) else {}),
        "description": _about(option),
        "userInterface": shown,
    }  # fmt: skip


def _text_parameter(
    name: str, told: str, value: str, choices: Sequence[str] = ()
) -> dict[str, Any]:
    control = "DROPDOWN_LIST" if choices else "LINE_EDIT"
    shown = {"label": told, "control": control, "groupLabel": "Conversion"}
    allowed: Mapping[str, Any] = {"allowedValues": [*choices]} if choices else {}
    return {
        "name": name, "type": "STRING", "default": value, **allowed, "userInterface": shown,
        "description": f"{told} of usdbrdf convert",
    }  # fmt: skip


def _shown(option: Option, control: str) -> dict[str, Any]:
    return {"label": option.name, "control": control, "groupLabel": "Conversion"}


def _about(option: Option) -> str:
    return f"{option.name} {option.unit} of usdbrdf convert"
