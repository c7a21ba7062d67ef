"""Frames and geometry, each found by an adapter, checked against each other: a Scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.colour import known_encodings
from usdbrdf.scan.findings import Findings
from usdbrdf.scan.frame_reading import PHOTOGRAPH_ENCODING, photograph_limits
from usdbrdf.scan.frame_record import FrameRecord, frames_from_records
from usdbrdf.scan.frame_rules import check_frames
from usdbrdf.scan.ingest_options import IngestOptions
from usdbrdf.scan.scan import Frames, Scan
from usdbrdf.scan.scan_geometry import ScanGeometry
from usdbrdf.scan.scan_rules import (
    refuse_rays_that_miss,
    refuse_without_parallax,
    rigid_records,
)


def scan_from_parts(
    records: Sequence[FrameRecord],
    read_geometry: Callable[[], ScanGeometry],
    options: IngestOptions,
    findings: Findings,
    *,
    name: str,
    adapter: str,
    source: Path,
    encoding: str,
    radiometric: bool,
    meters_per_unit: float,
    up_axis: str,
) -> Scan:
    """Check everything, cheap things first, and put the scan together.

    records         frames with pose and file; those without are in ``findings`` already
    read_geometry   called once the poses are known to be sound
    source          the file or folder that messages about the whole capture name
    meters_per_unit, up_axis   the format's own; the geometry's and the options' come first
    """
    total = len(records) + len(findings.dropped)
    rigid = rigid_records(records, findings, source, pose_scale=options.pose_scale)
    findings.refuse_too_few_frames(source, total)
    _refuse_same_image_twice(rigid, source)
    geometry = read_geometry()
    frames = frames_from_records(rigid, encoding=encoding, radiometric=radiometric)
    refuse_without_parallax(frames, geometry.mesh, source)
    hit_share = refuse_rays_that_miss(frames, geometry.mesh, source)
    usable = check_frames(
        frames, [r.name for r in rigid], findings, max_nonfinite=options.max_nonfinite
    )
    findings.refuse_too_few_frames(source, total)
    findings.warn_of_dropped_frames(source, total)
    findings.count("rays_hit_percent", round(100 * hit_share))
    return Scan(
        name=name,
        adapter=adapter,
        source=source,
        mesh=geometry.mesh,
        objects=geometry.objects,
        frames=frames_at(frames, usable),
        meters_per_unit=options.meters_per_unit or geometry.meters_per_unit or meters_per_unit,
        up_axis=options.up_axis or geometry.up_axis or up_axis,
        usd_geometry=geometry.usd_geometry,
        object_prims=geometry.object_prims,
        warnings=tuple(findings.warnings),
        counts=dict(findings.counts),
    )


def frames_at(frames: Frames, indices: Sequence[int]) -> Frames:
    """The frames with these indices, in this order."""
    rows = np.asarray(indices, np.int64)
    return replace(
        frames,
        image_paths=tuple(frames.image_paths[i] for i in rows),
        world_from_camera=frames.world_from_camera[rows],
        intrinsics=frames.intrinsics[rows],
        resolution=frames.resolution[rows],
        exposure_time=frames.exposure_time[rows],
        saturation_radiance=frames.saturation_radiance[rows],
        noise_floor_radiance=frames.noise_floor_radiance[rows],
    )


def as_photographs(
    records: Sequence[FrameRecord], findings: Findings, source: Path
) -> list[FrameRecord]:
    """8-bit sRGB records with the limits of such images, brought to one exposure."""
    findings.warn(
        f"{source.name}: the images are 8-bit sRGB photographs, so the result is not radiometric: "
        "colours and relative brightness only. [capture.ldr]"
    )
    saturation, noise_floor = photograph_limits(np.array([r.exposure_time for r in records]))
    return [
        replace(r, saturation_radiance=float(high), noise_floor_radiance=float(low))
        for r, high, low in zip(records, saturation, noise_floor, strict=True)
    ]


def radiance_encoding(options: IngestOptions, *, photographs: bool) -> str:
    """Colour space of the images; UsageError where the options contradict them."""
    encoding = options.encoding or (PHOTOGRAPH_ENCODING if photographs else "lin_rec709_scene")
    if encoding not in known_encodings():
        raise UsageError(
            f"--encoding {encoding!r}: not known. Use one of {', '.join(known_encodings())}. "
            "[usage.option]"
        )
    if photographs != (encoding == PHOTOGRAPH_ENCODING):
        kind = "8-bit photographs" if photographs else "scene-linear images"
        raise UsageError(
            f"--encoding {encoding}: the images are {kind}. Leave the option out. [usage.option]"
        )
    return encoding


def _refuse_same_image_twice(records: Sequence[FrameRecord], source: Path) -> None:
    seen: set[Path] = set()
    for record in records:
        if record.image_path in seen:
            raise InputRefused(
                f"{source}: the frame {record.name!r} is listed twice. Keep one entry. "
                "[capture.duplicate]"
            )
        seen.add(record.image_path)
