"""Task 1: a capture's files become scan.usdc, and the asset's folder is laid out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from usdbrdf.asset.header import Draft, StageHeader
from usdbrdf.asset.layers.interface import write_root
from usdbrdf.asset.layers.scan_layer import (
    ScanFiles,
    check_lightings,
    check_root,
    write_edits,
    write_scan_layer,
)
from usdbrdf.asset.layout import Asset
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_with
from usdbrdf.capture.develop import developed
from usdbrdf.capture.lightings import (
    in_own_folder,
    names_of_lightings,
    options_of_lightings,
    refuse_other_scenes,
    scan_of_lightings,
)
from usdbrdf.capture.native import as_copied, refuse_taken, write_capture
from usdbrdf.errors import UsageError
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.options import AUTO, IngestOptions
from usdbrdf.tasks.capture_inputs import inputs_of_captures, no_asset, parameters_of
from usdbrdf.tasks.layers_to_come import write_layers_to_come
from usdbrdf.tasks.photometry import asked_of_its_pixels
from usdbrdf.tasks.task import Task, warned


def ingest(
    capture: Path | Sequence[Path],
    asset: Asset,
    options: IngestOptions,
    adapter: str | None = None,
    *,
    plugins: bool = True,
    copy_to: Path | None = None,
) -> TaskResult:
    """Read and check a capture, or several of one scene in as many lightings, and write it as the
    weakest layer of ``asset``, and a single one as a capture of our own format into ``copy_to``.
    Raises InputRefused, and OwnershipConflict where ``copy_to`` is taken or the asset is of other
    lightings; nothing is published then."""
    paths = tuple(map(no_asset, [capture] if isinstance(capture, Path) else capture))
    lightings = names_of_lightings(paths)
    captures = dict(zip(lightings or ("",), paths, strict=True))
    options_of = options_of_lightings(options, lightings)
    if copy_to is not None:
        if lightings:
            raise UsageError(
                "--write-capture: a capture has one lighting. Write each. [usage.option]"
            )
        refuse_taken(copy_to, paths[0])
    check_lightings(asset, lightings)
    parameters = parameters_of(options) | ({"lightings": [*lightings]} if lightings else {})
    chosen = {
        name: choose_adapter(path, adapter, plugins=plugins) for name, path in captures.items()
    }
    beside = {k: (p, files_beside(chosen[k], p, options.mesh)) for k, p in captures.items()}
    inputs, places, hashes = inputs_of_captures(beside, options, asset)
    # Our own adapters change with the version of the code, which every stamp holds.
    if packages := sorted({one.package for one in chosen.values() if one.package}):
        parameters["adapter_package"] = ", ".join(packages)
    parameters = {"adapter": adapter or "recognised", "places": places, **parameters}
    task = Task(asset=asset, name="ingest", role="scan", parameters=parameters, inputs=inputs)

    def work(run: TaskRun) -> dict[str, Any]:
        scans = {k: read_with(chosen[k], path, options_of[k]) for k, path in captures.items()}
        refuse_other_scenes(scans)
        warnings = warned(sentence for scan in scans.values() for sentence in scan.warnings)
        header = StageHeader.of_scan(asset.name, *scans.values())
        check_root(asset, header, next(iter(scans.values())).capture_up)
        told: dict[str, Any] = {}
        for name, scan in scans.items():
            # Photographs through lenses become frames when nothing but pixels can be refused.
            scan = in_own_folder(scan, name)
            files, views, home = scan.frames.image_paths, scan.views, asset.folder
            scan = replace(scan, frames=developed(scan.frames, views, home, run.output_kept))
            images = [run.kept.get(str(file), file) for file in files]
            scans[name], told[name] = asked_of_its_pixels(scan, images, options)
            warnings += told[name].pop("warnings")
            told[name]["encoding"] = scan.frames.photograph_encoding or scan.frames.encoding
            if copy_to:
                write_capture(as_copied(scan, scans[name]), images, copy_to)
        scan = scan_of_lightings(scans, options.crease_angle_deg)
        draft = Draft(asset=asset, header=header, provenance=task.provenance)
        write_scan_layer(ScanFiles.of(asset, run.output), scan, draft, hashes)
        write_root(run.output_once(asset.root_layer.name), asset, header, scan.capture_up)
        write_edits(run.output_once(asset.edits_layer.name), asset, header)
        write_layers_to_come(run, asset, lightings, header)
        return {
            "adapter": ", ".join(dict.fromkeys(one.adapter for one in scans.values())),
            "frames": len(scan.frames),
            "objects": len(scan.objects),
            "objects_from": scan.label_source,
            "directives": {one.identifier: one.directive for one in scan.objects if one.directive},
            "triangles": len(scan.mesh.triangles),
            "radiometric": scan.frames.radiometric,
            "counts": scan.counts,
            "warnings": warnings,
            **({"lightings": told} if lightings else told[""]),
        }

    result = task.run(work)
    if copy_to is not None and not result.reran:
        scan = read_with(chosen[""], paths[0], options_of[""])
        frames = developed(scan.frames, scan.views, asset.folder, lambda *_: None)
        scan = replace(scan, frames=frames)
        again = options.refine_poses or options.objects == AUTO
        asked = asked_of_its_pixels(scan, frames.image_paths, options)[0] if again else scan
        write_capture(as_copied(scan, asked), frames.image_paths, copy_to)
    return result
