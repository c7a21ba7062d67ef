"""Task 1: a capture's files become scan.usdc, and the asset's folder is laid out."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from usdbrdf.asset.header import Draft, StageHeader
from usdbrdf.asset.layers.scan_layer import (
    check_root,
    write_edits,
    write_pending_layer,
    write_root,
    write_scan_layer,
)
from usdbrdf.asset.layout import ROLES, Asset, relative_path
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_with
from usdbrdf.capture.develop import developed
from usdbrdf.errors import InputRefused
from usdbrdf.files.paths import files_below
from usdbrdf.job.progress import warn
from usdbrdf.job.stamp import hash_of_files
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.options import IngestOptions
from usdbrdf.tasks.task import Task
from usdbrdf.untrusted.usd_files import USD_SUFFIXES, layers_of_usd


def ingest(
    capture: Path,
    asset: Asset,
    options: IngestOptions,
    adapter: str | None = None,
    *,
    plugins: bool = True,
) -> TaskResult:
    """Read and check a capture and write it as the weakest layer of ``asset``. Raises InputRefused
    for a capture that cannot be used; nothing is published then."""
    parameters: dict[str, Any] = {
        key: str(value) if isinstance(value, Path) else value
        for key, value in asdict(options).items()
        if key not in ("mesh", "objects", "frames", "allow_outside")
    }
    chosen = choose_adapter(capture, adapter, plugins=plugins)
    inputs, places = _inputs(capture, options, asset)
    if beside := files_beside(chosen, capture):
        inputs["beside"] = hash_of_files(beside)
    if chosen.package:
        # Our own adapters change with the version of the code, which every stamp holds.
        parameters["adapter_package"] = chosen.package
    task = Task(
        asset=asset,
        name="ingest",
        role="scan",
        parameters={"adapter": adapter or "recognised", "places": places, **parameters},
        inputs=inputs,
    )

    def work(run: TaskRun) -> dict[str, Any]:
        scan = read_with(chosen, capture, options)
        for warning in scan.warnings:
            warn(warning)
        header = StageHeader.of_scan(asset.name, scan)
        check_root(asset, header)
        # Photographs through lenses become frames last, when nothing else can be refused.
        scan = replace(scan, frames=developed(scan, asset.folder, run.output_kept))
        draft = Draft(asset=asset, header=header, provenance=task.provenance)
        write_scan_layer(run.output(f"layers/{asset.layer('scan').name}"), scan, draft)
        write_root(run.output_once(asset.root_layer.name), asset, header)
        write_edits(run.output_once(asset.edits_layer.name), asset, header)
        for role in ROLES[1:]:
            name = f"layers/{asset.layer(role).name}"
            write_pending_layer(run.output_once(name), role, header)
        return {
            "adapter": scan.adapter,
            "frames": len(scan.frames),
            "objects": len(scan.objects),
            "triangles": len(scan.mesh.triangles),
            "radiometric": scan.frames.radiometric,
            "counts": scan.counts,
            "warnings": list(scan.warnings),
        }

    return task.run(work)


def _inputs(
    capture: Path, options: IngestOptions, asset: Asset
) -> tuple[dict[str, str], dict[str, str]]:
    """Hashes of all that ingest may read: the capture's folder and those that its documents may
    point into, without the asset if that lies in one, and what options name. And where these
    lie, seen from scan.usdc, which names photographs and USD geometry by such paths: what is moved
    must be read anew."""
    folder = (capture if capture.is_dir() else capture.parent).resolve()
    if not capture.exists():
        raise InputRefused(f"{capture}: no such file or folder. Check the path. [capture.missing]")
    outside = {f"outside-{i}": place.resolve() for i, place in enumerate(options.allow_outside)}
    if options.frames is not None:
        outside["frames"] = options.frames.resolve()
    inputs = {
        label: hash_of_files(files_below(place, without=asset.folder), place)
        for label, place in ({"capture": folder} | outside).items()
    }
    mesh, objects = options.mesh, options.objects
    if mesh is not None and mesh.is_file():
        # What a USD mesh refers to may lie beside it, out of the capture.
        usd = mesh.suffix.lower() in USD_SUFFIXES
        layers = layers_of_usd(mesh, (folder, *options.allow_outside)) if usd else [mesh]
        inputs["mesh"] = hash_of_files(layers)
    if objects is not None and objects.is_file():
        inputs["objects"] = hash_of_files([objects])
    named = {"mesh": mesh.resolve()} if mesh is not None else {}
    places = {"capture": capture.resolve()} | named | outside
    here = asset.layer("scan").parent
    return inputs, {name: relative_path(place, here) for name, place in places.items()}
