"""The command line: arguments -> steps -> exit code."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import NoReturn

from usdbrdf import compare, evaluate, fit, ingest, options, relight, shade, texture, working_on
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.schema import plugin_path, validators_path
from usdbrdf.capture.adapters import Adapter, list_adapters
from usdbrdf.command_parser import command_parser
from usdbrdf.delivery.command_options import package_options
from usdbrdf.delivery.package import package
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.evaluation.command_options import evaluate_options
from usdbrdf.evaluation.compare_assets import DOCUMENT as COMPARISON
from usdbrdf.evaluation.compare_assets import comparison_line, figures
from usdbrdf.evaluation.evaluate_views import DOCUMENT as EVALUATION
from usdbrdf.evaluation.report import summary_line, truth_line
from usdbrdf.fit_options import fit_options
from usdbrdf.job.progress import printable, say, set_quiet
from usdbrdf.job.task import TaskResult
from usdbrdf.relighting.command_options import relight_options
from usdbrdf.validation.cure_layer import write_cures
from usdbrdf.validation.validate import has_errors, listed_rules, validate

Arguments = argparse.Namespace


class _Terminated(BaseException):
    """SIGTERM came. Not an Exception: nothing on the way may take it for a failure."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code, and raises nothing for a user's mistake."""
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        status = _run(arguments)
        print(end="", flush=True)
        return status
    except UsdBrdfError as error:
        return _refuse(str(error), error.exit_code)
    except MemoryError:
        return _refuse("out of memory. Choose a larger --texel-size. [environment.memory]", 4)
    except KeyboardInterrupt:
        return _refuse("interrupted; the same command goes on from here.", 130)
    except _Terminated:
        return _refuse("terminated; the same command goes on from here.", 143)
    except BrokenPipeError:
        # Whoever read our output has seen enough. Python would complain again at its exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception:
        traceback.print_exc()
        return _refuse("this is a defect of usdbrdf; please report it with the lines above.", 1)
    finally:
        signal.signal(signal.SIGTERM, before)


def _run(arguments: Sequence[str] | None) -> int:
    try:
        chosen = command_parser().parse_args(arguments)
    except SystemExit as done:  # --help, --version
        print(end="", flush=True)
        return int(done.code or 0)
    set_quiet(getattr(chosen, "quiet", False))
    return _COMMANDS.get(chosen.command, _run_steps)(chosen)


def _refuse(message: str, status: int) -> int:
    if sys.stderr is not None:
        print(f"usdbrdf: {printable(message)}", file=sys.stderr)
    return status


def _terminate(_signal: int, _frame: object) -> NoReturn:
    raise _Terminated


def _run_steps(chosen: Arguments) -> int:
    # All options are checked before anything is touched.
    steps = {name: _step(name, chosen) for name in chosen.steps}
    results: dict[str, TaskResult] = {}
    with working_on(chosen.output, hand_edits=chosen.hand_edits, wait_s=chosen.wait) as asset:
        for name, step in steps.items():
            results[name] = step(asset)
            if not results[name].reran:
                say(f"{name}: up to date")
        # Only ingest knows the name of a new asset.
        root = Asset.at(asset.folder).root_layer
    if chosen.json:
        shown = {
            name: {"reran": result.reran, "reason": result.reason, **result.summary}
            for name, result in results.items()
        }
        _print(json.dumps({"asset": str(root), "steps": shown}, indent=2))
    if "ingest" in results and results["ingest"].summary.get("radiometric") is False:
        say("warning: the images are not radiometric; albedo and fit have no absolute meaning.")
    say(f"{root}: {'written' if any(r.reran for r in results.values()) else 'up to date'}")
    return 0


def _step(name: str, chosen: Arguments) -> Callable[[Asset], TaskResult]:
    if name == "ingest":
        return partial(
            ingest,
            chosen.capture,
            options=options.ingest_options(chosen),
            adapter=chosen.adapter,
            plugins=not chosen.no_plugins,
        )
    if name == "texture":
        return partial(texture, options=options.texture_options(chosen))
    if name == "shade":
        return partial(shade, options=options.shade_options(chosen))
    return partial(fit, options=fit_options(chosen))


def _evaluate(chosen: Arguments) -> int:
    found = evaluate(chosen.asset, chosen.views, chosen.output, evaluate_options(chosen))
    if chosen.json:
        truth = {"truth": found["truth"]} if "truth" in found else {}
        told = {"output": str(chosen.output), **found["summary"], **truth}
        _print(json.dumps(told, indent=2))
    say(summary_line(found["summary"]))
    if "truth" in found:
        say(truth_line(found["truth"]))
    say(f"{chosen.output / EVALUATION}: written")
    return 0


def _compare(chosen: Arguments) -> int:
    found = compare(chosen.first, chosen.second, chosen.output)
    if chosen.json:
        _print(json.dumps({"output": str(chosen.output), **figures(found)}, indent=2))
    say(comparison_line(found))
    say(f"{chosen.output / COMPARISON}: written")
    return 0


def _relight(chosen: Arguments) -> int:
    summary = relight(chosen.asset, chosen.output, relight_options(chosen))
    if chosen.json:
        _print(json.dumps(summary, indent=2))
    say(f"{chosen.output}: written")
    return 0


def _package(chosen: Arguments) -> int:
    asset = _asset_at(chosen.asset).folder
    summary = package(asset, chosen.output, package_options(chosen))
    if chosen.json:
        _print(json.dumps(summary, indent=2))
    say(f"{chosen.output}: written, {summary['bytes']:,} bytes")
    return 0


def _validate(chosen: Arguments) -> int:
    asset = _asset_at(chosen.asset)
    root = asset.root_layer
    findings = validate(root)
    for finding in findings:
        _print(printable(str(finding)))
    if not findings:
        say(f"{root}: no errors")
    if chosen.fix is not None:
        cured = write_cures(asset, chosen.fix)
        done = f"cures {len(cured.findings)} findings once it is the first sublayer of {root}"
        say(f"{cured.layer}: {done if cured.findings else 'not written, nothing can be cured'}")
    return 7 if has_errors(findings) else 0


def _asset_at(place: Path) -> Asset:
    """The asset of a folder, or of the root layer in it."""
    asset = Asset.at(place.parent if place.is_file() else place)
    root = asset.root_layer
    if not root.is_file() or (place.is_file() and not place.samefile(root)):
        raise InputRefused(
            f"{place}: there is no asset here. Name the folder that usdbrdf convert wrote, or the "
            "NAME.usda in it. [asset.missing]"
        )
    return asset


def _rules(chosen: Arguments) -> int:
    rules = listed_rules()
    if chosen.json:
        _print(json.dumps([asdict(rule) for rule in rules], indent=2))
        return 0
    for rule in rules:
        severity = f" ({rule.severity})" if rule.severity else ""
        _print(printable(f"{rule.name}{severity}: {_first_sentence(rule.description)}"))
    return 0


def _first_sentence(text: str) -> str:
    return re.split(r"(?<!\be\.g)(?<!\bi\.e)\.\s", text, maxsplit=1)[0].rstrip(".") + "."


def _adapters(_chosen: Arguments) -> int:
    set_quiet(True)  # a broken adapter's warning is its line in the list
    found = list_adapters()
    width = max(len(adapter.name) for adapter in found)
    for adapter in found:
        _print(printable(f"{adapter.name:{width}}  {_about(adapter)} ({adapter.origin})"))
    return 0


def _about(adapter: Adapter) -> str:
    text = f"broken: {adapter.problem}" if adapter.module is None else adapter.description
    return " ".join(text.split())


def _plugin_path(chosen: Arguments) -> int:
    folders = [plugin_path()] if chosen.schemas else [plugin_path(), validators_path()]
    _print(os.pathsep.join(str(folder) for folder in folders))
    return 0


def _print(line: str) -> None:
    try:
        print(line, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise EnvironmentFailure(
            f"stdout cannot be written ({error.strerror}). [environment.output]"
        ) from error


_COMMANDS = {
    "evaluate": _evaluate,
    "compare": _compare,
    "relight": _relight,
    "package": _package,
    "validate": _validate,
    "rules": _rules,
    "adapters": _adapters,
    "plugin-path": _plugin_path,
}
