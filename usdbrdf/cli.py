"""The command line: arguments -> steps -> exit code."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from usdbrdf import (
    FitOptions,
    IngestOptions,
    Sampling,
    ShadeOptions,
    TextureOptions,
    fit,
    ingest,
    shade,
    texture,
    working_on,
)
from usdbrdf.errors import EnvironmentFailure, UsageError, UsdBrdfError
from usdbrdf.job.progress import say, set_quiet
from usdbrdf.job.stage import StageResult
from usdbrdf.job.stamp import code_version
from usdbrdf.scan.adapters import list_adapters
from usdbrdf.stage.asset import Asset
from usdbrdf.stage.schema import plugin_path
from usdbrdf.stage.validate import validate

Results = dict[str, StageResult]

EXIT_CODES = """exit codes:
  0 done   1 a bug of ours   2 wrong options   3 input refused (do not retry)
  4 disk, memory, permission or a missing package (retry may help)   5 folder busy
  6 output folder is not ours, or was edited by hand   130 interrupted   143 terminated"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code and never raises for a user's mistake."""
    signal.signal(signal.SIGTERM, _terminated)
    try:
        options = _parser().parse_args(arguments)
        set_quiet(getattr(options, "quiet", False))
        status: int = options.run(options)
        sys.stdout.flush()
        return status
    except UsdBrdfError as error:
        return _refuse(str(error), error.exit_code)
    except MemoryError:
        return _refuse("out of memory. Use fewer or larger texels (--texel-size).", 4)
    except KeyboardInterrupt:
        return _refuse("interrupted; the same command goes on from here.", 130)
    except BrokenPipeError:
        # Whoever read our output has seen enough. Python would complain again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except Exception:
        traceback.print_exc()
        return _refuse("this is a defect of usdbrdf; please report it with the lines above.", 1)


def _refuse(message: str, status: int) -> int:
    print(f"usdbrdf: {message}", file=sys.stderr)
    return status


def _terminated(_signal: int, _frame: object) -> NoReturn:
    # Raised between two steps of Python, so files are where the next run expects them.
    print("usdbrdf: terminated; the same command goes on from here.", file=sys.stderr)
    raise SystemExit(143)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="usdbrdf",
        description="Captured rooms and objects into USD assets with measured materials.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"usdbrdf {code_version()}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    def command(
        name: str, text: str, run: Callable[[argparse.Namespace], int], *groups: Any
    ) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            epilog=EXIT_CODES,
            formatter_class=_Formatter,
        )
        sub.set_defaults(run=run)
        for group in groups:
            group(sub)
        return sub

    everything = (_ingest_options, _texture_options, _shade_options, _environment_option)
    convert = command(
        "convert", "do all four steps: capture in, USD asset out", _convert,
        _asset_options, *everything, _fit_options,
    )  # fmt: skip
    start = command(
        "ingest", "read a capture into scan.usdc", _convert, _asset_options, _ingest_options
    )
    for sub, steps in ((convert, "ingest texture shade fit"), (start, "ingest")):
        sub.add_argument(
            "capture", type=Path, metavar="SCAN", help="capture folder or its main file"
        )
        sub.add_argument(
            "-o", "--output", type=Path, required=True, metavar="ASSET", help="asset folder"
        )
        sub.set_defaults(steps=steps.split())
    for name, text, groups in (
        ("texture", "project the frames: lit diffuse texture L_d", (_texture_options,)),
        ("shade", "trace irradiance, divide for albedo, find emitters", (_shade_options, _environment_option)),
        ("fit", "fit roughness and specular of each object", (_fit_options, _environment_option)),
    ):  # fmt: skip
        sub = command(name, text, _convert, _asset_options, *groups)
        sub.add_argument("output", type=Path, metavar="ASSET", help="asset folder made by ingest")
        sub.set_defaults(steps=[name])
    check = command("validate", "check an asset with USD's own validators", _validate)
    check.add_argument("asset", type=Path, metavar="ASSET")
    command("adapters", "list the capture formats that can be read", _adapters)
    command("plugin-path", "print the folder for PXR_PLUGINPATH_NAME", _plugin_path)
    return parser


class _Formatter(argparse.ArgumentDefaultsHelpFormatter, argparse.RawDescriptionHelpFormatter):
    """Defaults shown, epilog as written."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        if action.default in (None, False) or action.required:
            return action.help
        return super()._get_help_string(action)


def _asset_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress, errors only")
    parser.add_argument("--json", action="store_true", help="print a JSON summary to stdout")
    parser.add_argument("--wait", type=float, default=0.0, metavar="S", help="wait this long, in seconds, for a busy folder")  # fmt: skip
    edits = parser.add_mutually_exclusive_group()
    edits.add_argument("--adopt", action="store_const", const="adopt", dest="hand_edits", default="refuse", help="keep hand-made changes to our files as adopted-N.usda")  # fmt: skip
    edits.add_argument("--discard", action="store_const", const="discard", dest="hand_edits", help="drop hand-made changes to our files")  # fmt: skip


def _ingest_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("ingest")
    known = IngestOptions()
    group.add_argument(
        "--adapter", metavar="NAME", help="capture format; default: recognised by content"
    )
    group.add_argument("--no-plugins", action="store_true", help="use our own adapters only")
    group.add_argument("--mesh", type=Path, help="mesh to use instead of the capture's own")
    group.add_argument(
        "--objects", type=Path, help="object names to use instead of the capture's own"
    )
    group.add_argument("--crease-angle", type=float, default=known.crease_angle_deg, metavar="DEG", help="faces that meet at more than this, in degrees, meet in a sharp edge")  # fmt: skip
    group.add_argument(
        "--decimate", type=int, metavar="N", help="reduce the mesh to about N triangles"
    )
    group.add_argument("--min-component-area", type=float, default=known.min_component_area_m2, metavar="M2", help="without labels, parts of at least this area, in m^2, become objects")  # fmt: skip
    group.add_argument("--assume-srgb", action="store_true", help="accept 8-bit photographs as sRGB (not radiometric)")  # fmt: skip
    group.add_argument(
        "--encoding", metavar="NAME", help="colour space of the images, e.g. lin_ap1_scene"
    )
    group.add_argument("--pose-scale", type=float, metavar="S", help="uniform scale to divide out of the camera axes")  # fmt: skip
    group.add_argument("--max-nonfinite", type=float, default=known.max_nonfinite, metavar="SHARE", help="drop a frame with more NaN or infinite pixels than this share")  # fmt: skip
    group.add_argument("--allow-outside", type=Path, action="append", default=[], metavar="DIR", help="let the capture's documents point into this folder too")  # fmt: skip
    group.add_argument(
        "--meters-per-unit", type=float, metavar="M", help="length of a scene unit in metres"
    )
    group.add_argument("--up-axis", choices=("Y", "Z"), help="axis that points up")


def _texture_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("texture")
    known = TextureOptions()
    group.add_argument("--texel-size", type=float, metavar="M", help="in metres; default: the median pixel footprint of the frames")  # fmt: skip
    group.add_argument("--quantile", type=float, default=known.quantile, help="of the observations that becomes L_d")  # fmt: skip
    group.add_argument("--max-texels", type=int, default=known.max_texels, help="coarsen a chosen texel size to stay below")  # fmt: skip


def _shade_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("shade")
    known = ShadeOptions()
    group.add_argument("--sampling", choices=("mis", "cosine"), default=known.sampling.estimator, help="mis: lights and cosine combined, Sobol; cosine: the paper's")  # fmt: skip
    group.add_argument("--standard-error", type=float, default=known.sampling.standard_error, help="mis stops at this relative standard error of S")  # fmt: skip
    group.add_argument("--rays", type=int, default=None, metavar="N", help="at most (mis, default 2048) or exactly (cosine, default 10000) this many per texel")  # fmt: skip
    group.add_argument("--denoise", choices=("none", "oidn"), default=known.denoise, help="lightmap filter for S; needs the extra `denoise`")  # fmt: skip
    group.add_argument(
        "--seed", type=int, default=known.sampling.seed, help="of the random numbers"
    )


def _environment_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--environment", type=Path, metavar="HDR", help="latitude-longitude picture of the surroundings; default: black")  # fmt: skip


def _fit_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("fit")
    known = FitOptions()
    group.add_argument("--fit", choices=("scaled", "paper"), default=known.method, dest="method", help="scaled: free scale on L_d, class prior without evidence; paper: the paper's residual")  # fmt: skip
    group.add_argument("--max-pixels", type=int, default=known.max_pixels, help="of an object's target frame")  # fmt: skip


def _convert(options: argparse.Namespace) -> int:
    # Options are checked before anything is touched.
    steps = [_STEPS[name](options) for name in options.steps]
    if "capture" in options and not options.output.parent.is_dir():
        try:
            options.output.parent.mkdir(parents=True)
        except OSError as error:
            raise EnvironmentFailure(
                f"{options.output}: cannot make its parent folder ({error.strerror}). "
                "Name another one. [environment.output]"
            ) from error
    results: Results = {}
    with working_on(options.output, hand_edits=options.hand_edits, wait_s=options.wait) as asset:
        for name, step in zip(options.steps, steps, strict=True):
            results[name] = step(asset)
            if not results[name].reran:
                say(f"{name}: up to date")
    _report(asset, results, as_json=options.json)
    return 0


def _ingest_step(options: argparse.Namespace) -> Callable[[Asset], StageResult]:
    chosen = IngestOptions(
        mesh=options.mesh,
        objects=options.objects,
        crease_angle_deg=options.crease_angle,
        decimate=options.decimate,
        min_component_area_m2=options.min_component_area,
        assume_srgb=options.assume_srgb,
        encoding=options.encoding,
        pose_scale=options.pose_scale,
        max_nonfinite=options.max_nonfinite,
        allow_outside=tuple(options.allow_outside),
        meters_per_unit=options.meters_per_unit,
        up_axis=options.up_axis,
    )
    return lambda asset: ingest(
        options.capture, asset, chosen, options.adapter, plugins=not options.no_plugins
    )


def _texture_step(options: argparse.Namespace) -> Callable[[Asset], StageResult]:
    chosen = TextureOptions(
        texel_size=options.texel_size, quantile=options.quantile, max_texels=options.max_texels
    )
    return lambda asset: texture(asset, chosen)


def _shade_step(options: argparse.Namespace) -> Callable[[Asset], StageResult]:
    rays = options.rays
    if rays is None:
        rays = 10_000 if options.sampling == "cosine" else ShadeOptions().sampling.max_rays
    sampling = Sampling(
        estimator=options.sampling,
        standard_error=options.standard_error,
        max_rays=rays,
        seed=options.seed,
    )
    chosen = ShadeOptions(
        sampling=sampling, denoise=options.denoise, environment=options.environment
    )
    return lambda asset: shade(asset, chosen)


def _fit_step(options: argparse.Namespace) -> Callable[[Asset], StageResult]:
    chosen = FitOptions(
        method=options.method, max_pixels=options.max_pixels, environment=options.environment
    )
    return lambda asset: fit(asset, chosen)


_STEPS: dict[str, Callable[[argparse.Namespace], Callable[[Asset], StageResult]]] = {
    "ingest": _ingest_step,
    "texture": _texture_step,
    "shade": _shade_step,
    "fit": _fit_step,
}


def _report(asset: Asset, results: Results, *, as_json: bool) -> None:
    if as_json:
        steps = {
            name: {"reran": result.reran, "reason": result.reason, **result.summary}
            for name, result in results.items()
        }
        print(json.dumps({"asset": str(asset.root_layer), "steps": steps}, indent=2))
        return
    found = results["ingest"].summary if "ingest" in results else {}
    if found.get("radiometric") is False:
        say("warning: the images are not radiometric; albedo and fit have no absolute meaning.")
    say(f"wrote {asset.root_layer}")


def _validate(options: argparse.Namespace) -> int:
    asset = Asset.at(options.asset)
    if not asset.root_layer.is_file():
        raise UsageError(f"{options.asset}: no asset of usdbrdf in this folder. [usage.asset]")
    findings = validate(asset.root_layer)
    for finding in findings:
        print(finding)
    return 7 if findings else 0


def _adapters(_options: argparse.Namespace) -> int:
    for adapter in list_adapters():
        print(adapter)
    return 0


def _plugin_path(_options: argparse.Namespace) -> int:
    print(plugin_path())
    return 0
