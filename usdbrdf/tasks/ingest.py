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
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.capture.adapters import choose_adapter, files_beside, read_with
from usdbrdf.capture.develop import developed
from usdbrdf.capture.native import refuse_taken, write_capture
from usdbrdf.job.task import TaskResult, TaskRun
from usdbrdf.model.capture import Scan
from usdbrdf.options import AUTO, IngestOptions
from usdbrdf.tasks.capture_inputs import inputs_of_capture
from usdbrdf.tasks.photometry import asked_of_its_pixels
from usdbrdf.tasks.task import Task, warned


def ingest(
    capture: Path,
    asset: Asset,
    options: IngestOptions,
    adapter: str | None = None,
    *,
    plugins: bool = True,
    copy_to: Path | None = None,
) -> TaskResult:
    """Read and check a capture and write it as the weakest layer of ``asset``, and as a capture of
    our own format into the new folder ``copy_to``. Raises InputRefused for a capture that cannot be
    used, OwnershipConflict where ``copy_to`` is taken; nothing is published then."""
    if copy_to is not None:
        refuse_taken(copy_to, capture)
    parameters: dict[str, Any] = {
        key: str(value) if isinstance(value, Path) else value
        for key, value in asdict(options).items()
        if key not in ("mesh", "objects", "frames", "allow_outside")
    }
    if options.objects == AUTO:
        parameters["objects"] = AUTO
    chosen = choose_adapter(capture, adapter, plugins=plugins)
    inputs, places = inputs_of_capture(capture, options, asset, files_beside(chosen, capture))
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
        warnings = warned(scan.warnings)
        header = StageHeader.of_scan(asset.name, scan)
        check_root(asset, header)
        # Photographs through lenses become frames when nothing but pixels can be refused.
        files = [str(path) for path in scan.frames.image_paths]
        frames = developed(scan.frames, scan.views, asset.folder, run.output_kept)
        scan = replace(scan, frames=frames)
        images = [run.kept.get(file, Path(file)) for file in files]
        asked, told = asked_of_its_pixels(scan, images, options)
        if copy_to is not None:
            write_capture(_as_asked(scan, asked), images, copy_to)
        draft = Draft(asset=asset, header=header, provenance=task.provenance)
        write_scan_layer(run.output(f"layers/{asset.layer('scan').name}"), asked, draft)
        write_root(run.output_once(asset.root_layer.name), asset, header)
        write_edits(run.output_once(asset.edits_layer.name), asset, header)
        for role in ROLES[1:]:
            name = f"layers/{asset.layer(role).name}"
            write_pending_layer(run.output_once(name), role, header)
        return {
            "adapter": scan.adapter,
            "frames": len(scan.frames),
            "objects": len(asked.objects),
            "objects_from": scan.label_source,
            "triangles": len(scan.mesh.triangles),
            "radiometric": scan.frames.radiometric,
            "counts": scan.counts,
            "warnings": warnings,
            **told,
        }

    result = task.run(work)
    if copy_to is not None and not result.reran:
        scan = read_with(chosen, capture, options)
        frames = developed(scan.frames, scan.views, asset.folder, lambda *_: None)
        scan = replace(scan, frames=frames)
        again = options.refine_poses or options.objects == AUTO
        asked = asked_of_its_pixels(scan, frames.image_paths, options)[0] if again else scan
        write_capture(_as_asked(scan, asked), frames.image_paths, copy_to)
    return result


def _as_asked(scan: Scan, asked: Scan) -> Scan:
    """The scan, whose files are copied as they are, with the poses and objects that were found."""
    refined, captured = asked.frames.world_from_camera, asked.frames.captured_pose
    frames = replace(scan.frames, world_from_camera=refined, captured_pose=captured)
    return replace(scan, frames=frames, mesh=asked.mesh, objects=asked.objects)
