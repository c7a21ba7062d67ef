"""The commands of ``usdbrdf``, and which options each of them has."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from usdbrdf import options
from usdbrdf.delivery.command_options import add_package_options
from usdbrdf.errors import UsageError
from usdbrdf.evaluation.command_options import add_compare_options, add_evaluate_options
from usdbrdf.fit_options import add_fit_options
from usdbrdf.job.stamp import code_version
from usdbrdf.relighting.command_options import add_relight_options

EXIT_CODES = """exit codes:
  0 done   1 a defect of usdbrdf   2 wrong options   3 input refused (do not retry)
  4 disk, memory, permission or a missing package (retry may help)   5 asset folder busy
  6 asset folder is not ours, or files of ours were edited by hand   7 validate found errors
  130 interrupted   143 terminated"""

# command -> (its steps, what it does)
_STEP_COMMANDS = {
    "convert": ("ingest texture shade fit", "do all four steps: capture in, USD asset out"),
    "ingest": ("ingest", "read a capture into the layer scan.usdc"),
    "texture": ("texture", "project the frames: lit diffuse radiance L_d per texel"),
    "shade": ("shade", "trace irradiance S, divide for albedo, find the emitters"),
    "fit": ("fit", "fit roughness and specular of each object"),
}


def command_parser() -> argparse.ArgumentParser:
    """Its namespaces have ``command``; those of commands that run steps also ``steps``."""
    parser = _Parser(
        prog="usdbrdf",
        description="Captured rooms and objects into USD assets with measured materials.",
        epilog=EXIT_CODES,
        formatter_class=_HelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"usdbrdf {code_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(name: str, text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=EXIT_CODES,
            formatter_class=_HelpFormatter,
        )
        added.set_defaults(command=name)
        return added

    for name, (steps, text) in _STEP_COMMANDS.items():
        _add_step_arguments(command(name, text), steps.split())
    views = command("evaluate", "render views and compare them with photographs")
    options.add_talk_options(views)
    options.add_light_options(views)
    add_evaluate_options(views)
    pair = command("compare", "compare two assets of one scene, lit differently")
    options.add_talk_options(pair)
    add_compare_options(pair)
    relit = command("relight", "path trace the published asset in its own or in other light")
    options.add_talk_options(relit)
    add_relight_options(relit)
    packed = command("package", "write the asset as one file: .usdz or .glb")
    options.add_talk_options(packed)
    add_package_options(packed)
    check = command("validate", "check an asset by our rules and those of USD")
    check.add_argument("asset", type=Path, metavar="ASSET", help="asset folder")
    check.add_argument(
        "--fix",
        type=Path,
        metavar="LAYER",
        help="write what can be cured beyond doubt into a new layer, such as ASSET/fixes.usda, "
        "for you to add in front of edits.usda",
    )
    rules = command("rules", "list what validate looks for")
    rules.add_argument("--json", action="store_true", help="with descriptions, as JSON")
    command("adapters", "list the capture formats that can be read")
    plugins = command("plugin-path", "print what to put into PXR_PLUGINPATH_NAME")
    plugins.add_argument(
        "--schemas",
        action="store_true",
        help="without the validators, for applications whose Python has no usdbrdf: USD reports an "
        "error there when all validators are asked for",
    )
    return parser


def _add_step_arguments(parser: argparse.ArgumentParser, steps: list[str]) -> None:
    parser.set_defaults(steps=steps)
    add = parser.add_argument
    if "ingest" in steps:
        add("capture", type=Path, metavar="SCAN", help="capture folder or its main file")
        add(
            "-o",
            "--output",
            type=Path,
            required=True,
            metavar="ASSET",
            help="asset folder, made if it is not there",
        )
    else:
        add("output", type=Path, metavar="ASSET", help="asset folder made by ingest")
    options.add_run_options(parser)
    if "texture" in steps or "fit" in steps:
        options.add_memory_option(parser)
    if len(steps) > 1:
        options.add_edit_options(parser)
    if "ingest" in steps:
        options.add_ingest_options(parser)
    if "texture" in steps:
        options.add_texture_options(parser)
    if "shade" in steps:
        options.add_shade_options(parser)
    if "fit" in steps:
        add_fit_options(parser)
    if "shade" in steps or "fit" in steps:
        options.add_light_options(parser)


class _Parser(argparse.ArgumentParser):
    """Refuses wrong options with one sentence, by an exception; takes no abbreviations, which a
    later version might have to read differently."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{**kwargs, "allow_abbrev": False})

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}. See {self.prog} --help. [usage.option]")


class _HelpFormatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Shows defaults; leaves the epilog as it was written."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        told = action.default is None or action.default is False or action.default == []
        if told or action.const is not None:
            return action.help
        return super()._get_help_string(action)
