"""A document with views of a capture -> frames in metres, in the world of the capture's asset."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pxr import Usd, UsdGeom

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.frames import frames_from_stage
from usdbrdf.capture.checks import (
    check_frames,
    refuse_photographs,
    refuse_rays_that_miss,
    rigid_records,
)
from usdbrdf.capture.findings import Findings, FrameRecord, frames_from_records
from usdbrdf.capture.parts import frames_at
from usdbrdf.capture.transforms import frame_records
from usdbrdf.errors import InputRefused
from usdbrdf.files.frames import PHOTOGRAPH_ENCODING, PHOTOGRAPH_NOISE_FLOOR, PHOTOGRAPH_SATURATION
from usdbrdf.job.progress import say
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import ScanMesh
from usdbrdf.model.scene import Scene
from usdbrdf.options import IngestOptions

# A reference may leave much of a picture unknown; a view that holds next to nothing is dropped.
_MAX_UNKNOWN = 0.999


@dataclass(frozen=True, kw_only=True)
class Views:
    """Photographs to compare with: their names in the document, and themselves in metres."""

    names: tuple[str, ...]
    frames: Frames


def views_from_file(
    source: Path,
    asset: Asset,
    stage: Usd.Stage,
    scene: Scene,
    allow_outside: tuple[Path, ...] = (),
) -> Views:
    """Read and check a nerfstudio document (transforms.json, views.json) of the asset's capture.

    Its poses are in the capture's frame and unit, as those that ingest read, and are treated as
    ingest treated those: applied_transform undone, scaled axes divided by the same --pose-scale.
    Images have the capture's encoding. Views that cannot be used are dropped with a warning;
    InputRefused where none is left or where the cameras do not see the asset.
    """
    captured = frames_from_stage(stage)
    options = IngestOptions(allow_outside=allow_outside)
    findings = Findings()
    records = frame_records(source, options, findings)
    total = len(records) + len(findings.dropped)
    if refuse_photographs([r.image_path for r in records], assume_srgb=not captured.radiometric):
        records = [_as_the_captures_photographs(r, captured) for r in records]
    pose_scale = read_provenance(asset.layer("scan")).get("parameters", {}).get("pose_scale")
    rigid = rigid_records(records, findings, source, pose_scale=pose_scale)
    _refuse_none(rigid, findings, source)
    frames = frames_from_records(
        rigid, encoding=captured.encoding, radiometric=captured.radiometric
    )
    frames.world_from_camera[:, :3, 3] *= UsdGeom.GetStageMetersPerUnit(stage)
    refuse_rays_that_miss(frames, _mesh(scene), source)
    names = [record.name for record in rigid]
    usable = check_frames(frames, names, findings, max_nonfinite=_MAX_UNKNOWN)
    _refuse_none(usable, findings, source)
    findings.warn_of_dropped_frames(source, total)
    for warning in findings.warnings:
        say(f"warning: {warning}")
    return Views(names=tuple(names[i] for i in usable), frames=frames_at(frames, usable))


def _as_the_captures_photographs(record: FrameRecord, captured: Frames) -> FrameRecord:
    """8-bit record with its limits in the unit that ingest gave the capture's photographs."""
    if captured.encoding != PHOTOGRAPH_ENCODING:
        raise InputRefused(
            f"{record.image_path}: an 8-bit photograph, but the capture's images are "
            f"{captured.encoding}. Use views of the same kind. [evaluate.views]"
        )
    unit = captured.saturation_radiance[0] * captured.exposure_time[0] / PHOTOGRAPH_SATURATION
    scale = float(unit / record.exposure_time)
    return replace(
        record,
        saturation_radiance=PHOTOGRAPH_SATURATION * scale,
        noise_floor_radiance=PHOTOGRAPH_NOISE_FLOOR * scale,
    )


def _mesh(scene: Scene) -> ScanMesh:
    return ScanMesh(
        points=scene.points,
        triangles=scene.triangles,
        corner_normals=scene.corner_normals,
        face_object=scene.face_object,
    )


def _refuse_none(left: list[FrameRecord] | list[int], findings: Findings, source: Path) -> None:
    if left:
        return
    first = findings.dropped[0] if findings.dropped else None
    why = f" The first, {first.name!r}: {first.reason}." if first else ""
    raise InputRefused(
        f"{source}: none of its views can be used.{why} Correct the document or its images. "
        "[evaluate.views]"
    )
