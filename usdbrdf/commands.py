"""The commands of ``usdbrdf``: each class says what its command takes, ``run`` what it does.

What takes time to load is loaded where it is needed: no page of help waits for NumPy or USD.
"""

from __future__ import annotations

import json
import os
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

from usdbrdf import options
from usdbrdf.cluster.options import ClusterOptions
from usdbrdf.command_kinds import Locking, OnCapture, Run, RunOnCapture, Talking, Waiting
from usdbrdf.command_parser import Command, completion
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.farm_commands import Farm, FarmTable, FarmWork
from usdbrdf.job.interrupts import loading
from usdbrdf.job.progress import printable, set_quiet, show
from usdbrdf.option import REQUIRED, option
from usdbrdf.options import EditOptions
from usdbrdf.paper.options import PaperOptions


class Inspect(OnCapture):
    """Say what a capture holds and what convert would refuse; nothing is written."""

    capture: Path = option("SCAN", REQUIRED)
    "capture folder or its main file"
    inspect: options.InspectOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.tasks.inspect import inspect
        found = inspect(self.capture, self.inspect, self.adapter, plugins=self.plugins)
        if self.json:
            show(json.dumps(found.summary(), indent=2), whole=True)
        else:
            show("\n".join(printable(line) for line in found.lines()))
        if found.refusals:
            raise found.refusals[0]
        return 0


class Convert(EditOptions, RunOnCapture):
    """Do all four steps: capture in, USD asset out."""

    options: options.ConvertOptions
    cluster: ClusterOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.pipeline import convert
        results = convert(
            self.capture, self.output, self.options, adapter=self.adapter, plugins=self.plugins,
            hand_edits=self.hand_edits, wait_s=self.wait_s, without_lock=self.without_lock,
            cluster=self.cluster,
        )  # fmt: skip
        return self.report(results, self.output)


class Ingest(RunOnCapture):
    """Read a capture into the layer scan.usdc."""

    write_capture: Path | None = option("--write-capture DIR", None)
    "write what was read as a capture of our own format too, into a new folder"
    ingest: options.IngestOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.pipeline import ingest
        with self.working_on(self.output) as asset:
            done = ingest(
                self.capture, asset, self.ingest, self.adapter, plugins=self.plugins,
                copy_to=self.write_capture,
            )  # fmt: skip
        return self.report({"ingest": done}, self.output)


class MergeBrackets(Talking):
    """Merge brackets of 8-bit photographs into a capture of radiance."""

    capture: Path = option("SCAN", REQUIRED)
    "folder with transforms.json, whose frames have brackets or share a transform_matrix"
    output: Path = option("-o --output DIR", REQUIRED)
    "new folder for the capture of one EXR for each view"

    def run(self) -> int:
        with loading():
            from usdbrdf.capture.bracketed import merge_brackets
            from usdbrdf.capture.native import refuse_taken
        refuse_taken(self.output, self.capture)
        found = merge_brackets(self.capture, self.output)
        told = (
            f"{self.output}: written, {found['brackets']} frames of {found['photographs']} "
            f"photographs over {found['stops']:.1f} stops; radiometric up to one scale; clipped in "
            f"all {found['clipped_share']:.2%}, contradicting each other "
            f"{found['contradicting_share']:.2%} of the pixels; {found['unchecked_share']:.0%} of "
            "the exposures could not be held against the one next to them"
        )
        return self.told({"capture": str(self.output), **found}, told)


class DevelopRaw(Talking):
    """Develop camera raw files into a capture of radiance."""

    capture: Path = option("SCAN", REQUIRED)
    "folder with transforms.json, whose frames are raw files (DNG, CR3, NEF, ARW, ...)"
    output: Path = option("-o --output DIR", REQUIRED)
    "new folder for the capture of one EXR for each of them"

    def run(self) -> int:
        with loading():
            from usdbrdf.capture.native import refuse_taken
            from usdbrdf.capture.raw_frames import develop_raw
        refuse_taken(self.output, self.capture)
        found = develop_raw(self.capture, self.output)
        told = (
            f"{self.output}: written, {found['frames']} frames over {found['stops']:.1f} stops; "
            f"radiometric up to one scale; clipped {found['clipped_share']:.2%} of the pixels; "
            f"white balance drifts by {found['white_balance_drift_stops']:.2f} stops"
        )
        return self.told({"capture": str(self.output), **found}, told)


class DevelopVideo(Talking):
    """Make a capture of radiance of a video whose exposure changes from frame to frame."""

    capture: Path = option("SCAN", REQUIRED)
    "folder with transforms.json, which names a video, its exposures and each frame's number in it"
    output: Path = option("-o --output DIR", REQUIRED)
    "new folder for the capture of one EXR for each frame that is named"

    def run(self) -> int:
        with loading():
            from usdbrdf.capture.native import refuse_taken
            from usdbrdf.capture.video_frames import develop_video
        refuse_taken(self.output, self.capture)
        found = develop_video(self.capture, self.output)
        told = (
            f"{self.output}: written, {found['frames']} frames over {found['stops']:.1f} stops; "
            f"radiometric up to one scale; clipped {found['clipped_share']:.2%} of the pixels; "
            f"{len(found['contradicting'])} frames contradict their stated exposure"
        )
        return self.told({"capture": str(self.output), **found}, told)


class _RunOnAsset(Run):
    asset: Path = option("ASSET", REQUIRED)
    "asset folder made by ingest"

    def run(self) -> int:
        with loading():
            from usdbrdf import pipeline
        name, cluster = type(self).__name__.lower(), getattr(self, "cluster", None)
        with self.working_on(self.asset) as asset, pipeline.workers_of(cluster) as workers:
            own = [workers] if cluster else []
            done = getattr(pipeline, name)(asset, getattr(self, name), *own)
        return self.report({name: done}, self.asset)


class Texture(_RunOnAsset):
    """Project the frames: lit diffuse radiance L_d per texel."""

    texture: options.TextureOptions
    cluster: ClusterOptions


class Shade(_RunOnAsset):
    """Trace irradiance S, divide for albedo, find the emitters."""

    shade: options.ShadeOptions
    cluster: ClusterOptions


class Fit(_RunOnAsset):
    """Fit roughness and specular of each object."""

    fit: options.FitOptions
    cluster: ClusterOptions


class _WithAsset(Waiting, Talking):
    asset: Path = option("ASSET", REQUIRED)
    "asset folder; it is not changed"


class Evaluate(_WithAsset):
    """Render views and compare them with photographs."""

    output: Path = option("-o --output FOLDER", Path("evaluation"))
    "folder for figures and pictures, made if it is not there"
    views: Path = option("--views FILE", REQUIRED, file=True)
    "nerfstudio document (transforms.json) of views of the capture, held out or its own"
    options: options.EvaluateOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.evaluation.evaluate_views import DOCUMENT, evaluate
            from usdbrdf.evaluation.report import summary_line, truth_line
        with self.reading(self.asset):
            found = evaluate(self.asset, self.views, self.output, self.options)
        truth = {"truth": found["truth"]} if "truth" in found else {}
        lines = [summary_line(found["summary"]), f"{self.output / DOCUMENT}: written"]
        if truth:
            lines.insert(1, truth_line(found["truth"]))
        return self.told({"output": str(self.output), **found["summary"], **truth}, *lines)


class Compare(Waiting, Talking):
    """Compare two assets of one scene, lit differently."""

    first: Path = option("ASSET", REQUIRED)
    "asset folder; it is not changed"
    second: Path = option("OTHER", REQUIRED)
    "another of the same scene; it is not changed"
    output: Path = option("-o --output FOLDER", Path("comparison"))
    "folder for figures and pictures, made if it is not there"
    options: options.CompareOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.evaluation import compare_assets as made
        with self.reading(self.first, self.second):
            found = made.compare(self.first, self.second, self.output, self.options)
        written = f"{self.output / made.DOCUMENT}: written"
        summary = {"output": str(self.output), **made.figures(found)}
        return self.told(summary, made.comparison_line(found), written)


class Paper(Waiting, Talking):
    """Make the paper's tables and figures of two assets of one scene, lit differently."""

    first: Path = option("ASSET", REQUIRED)
    "asset folder; it is not changed"
    second: Path = option("OTHER", REQUIRED)
    "another of the same scene; it is not changed"
    output: Path = option("-o --output FOLDER", Path("paper"))
    "folder for paper.md, tables and figures, made if it is not there"
    options: PaperOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.evaluation.report import FILES
            from usdbrdf.paper import write_paper as made
            from usdbrdf.paper.text import paper_line
        with self.reading(self.first, self.second):
            found = made.write_paper(self.first, self.second, self.output, self.options)
        summary = {k: v for k, v in found.items() if k not in ("objects", "materials", FILES)}
        summary["views"] = [
            {key: side[key] for key in ("summary", "changes")} for side in found["views"]
        ]
        written = f"{self.output / 'paper.md'}: written, {len(found[FILES])} files"
        return self.told({"output": str(self.output), **summary}, paper_line(found), written)


class Relight(_WithAsset):
    """Path trace the published asset in its own or in other light."""

    output: Path = option("-o --output IMAGE", REQUIRED)
    """.exr: linear float radiance; .png, .jpg: exposed, sRGB; with --views a folder; .xml: the
    scene itself for Mitsuba, with meshes and pictures beside it"""
    options: options.RelightOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.relighting.relight import relight
        with self.reading(self.asset):
            summary = relight(self.asset, self.output, self.options)
        return self.told(summary, f"{self.output}: written")


class Package(_WithAsset):
    """Write the asset as one file: .usdz or .glb."""

    output: Path = option("-o --output FILE", REQUIRED)
    ".usdz, or .glb (metres, y up) for what reads no USD; replaced if it is there"
    options: options.PackageOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.delivery.package import package
        with self.reading(self.asset):
            summary = package(self.asset, self.output, self.options)
        return self.told(summary, f"{self.output}: written, {summary['bytes']:,} bytes")


class Publish(Locking, _WithAsset):
    """Write the asset as a version that never changes, for others to take in."""

    destination: Path = option("DEST", REQUIRED)
    "folder of all its versions, made if it is not there"
    options: options.PublishOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.delivery.publish import publish
        summary = publish(
            self.asset, self.destination, self.options, wait_s=self.wait_s,
            without_lock=self.without_lock,
        )  # fmt: skip
        done = f"written, {summary['files']} files, {summary['bytes']:,} bytes"
        told = done if summary["new"] else "holds this already, nothing was written"
        return self.told(summary, f"{summary['publish']}: {told}")


class Report(_WithAsset):
    """Write one HTML page on which people see whether to believe the asset."""

    output: Path = option("-o --output FILE", REQUIRED)
    ".html, complete in itself; replaced if it is there"
    options: options.ReportOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.page.report import report
        with self.reading(self.asset):
            summary = report(self.asset, self.output, self.options)
        return self.told(summary, f"{self.output}: written, {summary['bytes']:,} bytes")


class Advise(Locking, Talking):
    """Say what to photograph next, as guide cameras in a layer of their own."""

    asset: Path = option("ASSET", REQUIRED)
    "asset folder; only layers/advice.usda in it is written"
    options: options.AdviseOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.advice.advise import advise
            from usdbrdf.advice.words import lines
        found = advise(self.asset, self.options, wait_s=self.wait_s, without_lock=self.without_lock)
        return self.told(found, *lines(found))


class View(_WithAsset):
    """Serve that page on this machine alone, where verdicts are saved into ASSET/review.usda."""

    port: int = option("--port N", 0, (0, 65535), unset="any that is free")
    "of 127.0.0.1"
    browser: bool = option("--no-browser", True)
    "print the address, open nothing"
    options: options.ReportOptions

    def run(self) -> int:
        with loading():
            from usdbrdf.page.server import view
        view(self.asset, self.options, port=self.port, browser=self.browser, wait_s=self.wait_s)
        return 0


class Validate(Waiting, Talking):
    """Check an asset by our rules and those of USD."""

    asset: Path = option("ASSET", REQUIRED)
    "asset folder"
    fix: Path | None = option("--fix LAYER", None)
    """write what can be cured beyond doubt into a new layer, such as ASSET/fixes.usda, for you to
    add in front of edits.usda"""

    def run(self) -> int:
        with loading():
            from usdbrdf.asset.layout import Asset
            from usdbrdf.validation.validate import has_errors, validate, write_cures
        root = (asset := Asset.made(self.asset)).root_layer
        with self.reading(root):
            findings = validate(root)
            cured = write_cures(asset, self.fix) if self.fix is not None else None
        for finding in () if self.json else findings:
            show(printable(str(finding)))
        lines = [] if findings else [f"{root}: no errors"]
        found = [asdict(finding) for finding in findings]
        summary: dict[str, Any] = {"asset": str(root), "findings": found, "fix": None}
        if cured is not None:
            done = f"cures {len(cured.findings)} findings once it is the first sublayer of {root}"
            done = done if cured.findings else "not written, nothing can be cured"
            lines.append(f"{cured.layer}: {done}")
            written = str(cured.layer) if cured.findings else None
            summary["fix"] = {"layer": written, "findings": list(map(asdict, cured.findings))}
        return 7 if self.told(summary, *lines) or has_errors(findings) else 0


class Rules(Command):
    """List what validate looks for."""

    json: bool = option("--json", False)
    "with descriptions, as JSON"

    def run(self) -> int:
        with loading():
            from usdbrdf.validation.validate import listed_rules
        rules = listed_rules()
        if self.json:
            show(json.dumps([asdict(rule) for rule in rules], indent=2), whole=True)
            return 0
        for rule in rules:
            severity = f" ({rule.severity})" if rule.severity else ""
            first = re.split(r"(?<!\be\.g)(?<!\bi\.e)\.\s", rule.description, maxsplit=1)[0]
            show(printable(f"{rule.name}{severity}: {first.rstrip('.')}."))
        return 0


class Adapters(Command):
    """List the capture formats that can be read."""

    def run(self) -> int:
        with loading():
            from usdbrdf.capture.adapters import list_adapters
        set_quiet(True)  # a broken adapter's warning is its line in the list
        found = list_adapters()
        width = max(len(adapter.name) for adapter in found)
        for adapter in found:
            about = f"broken: {adapter.problem}" if adapter.problem else adapter.description
            show(printable(f"{adapter.name:{width}}  {' '.join(about.split())} ({adapter.origin})"))
        return 0


class Doctor(Command):
    """Say what of the machine and the extras is there, and whether what every run needs works."""

    json: bool = option("--json", False)
    "print the findings as JSON to stdout, nothing else"

    def run(self) -> int:
        with loading():
            from usdbrdf import doctor
        findings = doctor.examine()
        if self.json:
            told = {"works": not doctor.is_broken(findings), "findings": [*map(asdict, findings)]}
            show(json.dumps(told, indent=2), whole=True)
        else:
            show("\n".join(map(printable, doctor.lines(findings))))
        return EnvironmentFailure.exit_code if doctor.is_broken(findings) else 0


class Completion(Command):
    """Print what lets a shell complete command lines."""

    shell: Literal["bash", "zsh", "fish"] = option("SHELL", REQUIRED)
    "bash, zsh or fish; for bash: source <(usdbrdf completion bash)"

    def run(self) -> int:
        show(completion(self.shell, COMMANDS))
        return 0


class PluginPath(Command):
    """Print what to put into PXR_PLUGINPATH_NAME."""

    schemas: bool = option("--schemas", False)
    """without the validators, for applications whose Python has no usdbrdf: USD reports an error
    there when all validators are asked for"""

    def run(self) -> int:
        with loading():
            from usdbrdf.asset.schemas import plugin_path, validators_path
        folders = [plugin_path()] if self.schemas else [plugin_path(), validators_path()]
        show(os.pathsep.join(str(folder) for folder in folders))
        return 0


_TASKS: tuple[type[Command], ...] = (Inspect, Convert, Ingest, Texture, Shade, Fit)
_OTHERS = (
    MergeBrackets, DevelopRaw, DevelopVideo, Evaluate, Compare, Paper, Relight, Package, Publish,
    Report, View, Advise, Validate, Farm, FarmWork, FarmTable, Rules, Adapters, Doctor, Completion,
    PluginPath,
)  # fmt: skip
COMMANDS = {
    re.sub("(?<!^)(?=[A-Z])", "-", command.__name__).lower(): command
    for command in (*_TASKS, *_OTHERS)
}
