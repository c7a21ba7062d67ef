"""Frames and geometry, each found by an adapter, checked against each other: a Scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.checks import (
    Findings,
    FrameRecord,
    at_image_size,
    check_frames,
    frames_from_records,
    refuse_rays_that_miss,
    refuse_without_parallax,
    rigid_records,
)
from usdbrdf.capture.labels import label_table, objects_with_faces, segmentation
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.files.colour import known_encodings
from usdbrdf.files.frames import PHOTOGRAPH_ENCODING, photograph_limits
from usdbrdf.files.naming import unique_identifiers
from usdbrdf.geometry.mesh_clean import clean_mesh
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.sides import Sides, sides_from_cameras, turned_towards_cameras
from usdbrdf.model.arrays import Bool
from usdbrdf.model.capture import Frames, Scan
from usdbrdf.model.mesh import ObjectLabel, ScanMesh
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted.mesh_files import mesh_from_file
from usdbrdf.untrusted.usd_files import meshes_from_usd


@dataclass(frozen=True, kw_only=True)
class ScanGeometry:
    """Mesh and objects as in ``Scan``, the faces wound as they came.

    has_normals                    (F,) bool: the file gives the face's normals; None: it gives none
    usd_geometry, object_prims     set if the file is USD and is to be referenced, not copied
    meters_per_unit, up_axis       None where the file does not say
    """

    mesh: ScanMesh
    objects: tuple[ObjectLabel, ...]
    has_normals: Bool | None = None
    usd_geometry: Path | None = None
    object_prims: tuple[str, ...] = ()
    meters_per_unit: float | None = None
    up_axis: str | None = None


USD_SUFFIXES = frozenset({".usd", ".usda", ".usdc", ".usdz"})


def geometry_from_usd(
    path: Path, options: IngestOptions, findings: Findings, *, capture_root: Path
) -> ScanGeometry:
    """Every mesh below the default prim is one object, by its display name or its own."""
    if options.decimate is not None:
        raise UsageError(
            f"{path}: --decimate does not reduce geometry that is referenced from USD. Reduce it "
            "in the program it comes from, or give a PLY. [usage.option]"
        )
    if not path.is_file():
        raise InputRefused(
            f"{path}: this mesh does not exist. Name the mesh with --mesh. [mesh.missing]"
        )
    found = meshes_from_usd(path, allow=(capture_root, *options.allow_outside))
    for sentence in found.warnings:
        findings.warn(sentence)
    mesh = found.mesh
    missing = np.isnan(mesh.corner_normals[:, 0, 0])
    if missing.any():
        mesh.corner_normals[missing] = corner_normals(
            mesh.points, mesh.triangles[missing], options.crease_angle_deg
        )
    return ScanGeometry(
        mesh=mesh,
        has_normals=~missing,
        objects=tuple(
            ObjectLabel(identifier=identifier, label=label)
            for identifier, label in zip(
                unique_identifiers(found.labels), found.labels, strict=True
            )
        ),
        usd_geometry=path.resolve(),
        object_prims=found.object_prims,
        meters_per_unit=found.meters_per_unit,
        up_axis=found.up_axis,
    )


def geometry_from_file(
    mesh_path: Path,
    objects_path: Path | None,
    options: IngestOptions,
    findings: Findings,
    *,
    capture_root: Path,
    meters_per_unit: float = 1.0,
) -> ScanGeometry:
    """Read, check, segment and clean a mesh.

    objects_path     objects.json, or None
    capture_root     folder inside which a USD file may refer to others
    meters_per_unit  of the adapter, for areas in square metres
    """
    if mesh_path.suffix.lower() in USD_SUFFIXES:
        return geometry_from_usd(mesh_path, options, findings, capture_root=capture_root)
    mesh = mesh_from_file(mesh_path)
    if mesh.kept is not None:
        broken = int((~mesh.kept).sum())
        findings.count("broken_faces", broken)
        findings.warn(
            f"{mesh_path.name}: {broken} of {len(mesh.kept)} faces had NaN corners or pointed to "
            "vertices that do not exist, and have been removed. [mesh.broken]"
        )
    table = label_table(objects_path) if objects_path is not None else None
    split = segmentation(
        mesh,
        table,
        table_path=objects_path,
        min_area=options.min_component_area_m2 / meters_per_unit**2,
    )
    if mesh.face_label is None and (table is None or table.face_id is None):
        findings.warn(
            f"{mesh_path.name}: no object labels; {len(split.labels)} objects have been made from "
            "connected parts. [objects.none]"
        )
    clean = clean_mesh(
        mesh.points,
        mesh.triangles,
        split.face_object,
        decimate=options.decimate,
        label=str(mesh_path),
    )
    for name, number in clean.counts.items():
        findings.count(name, number)
    face_object, objects = objects_with_faces(clean.face_object, split.labels)
    return ScanGeometry(
        mesh=ScanMesh(
            points=clean.points,
            triangles=clean.triangles,
            corner_normals=corner_normals(clean.points, clean.triangles, options.crease_angle_deg),
            face_object=face_object,
        ),
        objects=objects,
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
    meters_per_unit: float = 1.0,
    up_axis: str = "Z",
) -> Scan:
    """Check everything, cheap things first, and put the scan together.

    records         frames with pose and file; those without are in ``findings`` already
    read_geometry   called once the poses are known to be sound
    source          the file or folder that messages about the whole capture name
    meters_per_unit, up_axis   the format's own; the geometry's and the options' come first
    """
    total = len(records) + len(findings.dropped)
    _refuse_same_image_twice(records, source)
    rigid = rigid_records(records, findings, source, pose_scale=options.pose_scale)
    rigid = at_image_size(rigid, findings, source)
    findings.refuse_too_few_frames(source, total)
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
    frames = frames_at(frames, usable)
    sides = _sides(geometry, frames, findings)
    return Scan(
        name=name,
        adapter=adapter,
        source=source,
        mesh=turned_towards_cameras(
            geometry.mesh, sides, geometry.has_normals, options.crease_angle_deg
        ),
        objects=geometry.objects,
        frames=frames,
        meters_per_unit=options.meters_per_unit or geometry.meters_per_unit or meters_per_unit,
        up_axis=options.up_axis or geometry.up_axis or up_axis,
        usd_geometry=geometry.usd_geometry,
        object_prims=geometry.object_prims,
        turned_faces=sides.turned,
        warnings=tuple(findings.warnings),
        counts=dict(findings.counts),
    )


def _sides(geometry: ScanGeometry, frames: Frames, findings: Findings) -> Sides:
    """Which faces have to be turned towards the cameras, and which show both sides."""
    cameras = (frames.camera(i) for i in range(len(frames)))
    sides = sides_from_cameras(geometry.mesh, cameras)
    turned, both = int(sides.turned.sum()), int(sides.both.sum())
    findings.count("faces_turned", turned)
    findings.count("faces_of_two_sides", both)
    if turned:
        findings.warn(
            f"{turned} of {len(sides.turned)} faces are wound away from the cameras and have been "
            "turned in the asset; the mesh stays as it is. [mesh.winding]"
        )
    if both and geometry.usd_geometry is not None:
        # Nothing is added to meshes that are referenced: such a face keeps the side seen more.
        return Sides(turned=sides.turned, both=np.zeros_like(sides.both))
    return sides


def frames_at(frames: Frames, indices: Sequence[int]) -> Frames:
    """The frames with these indices, in this order."""
    rows = np.asarray(indices, np.int64)
    columns: dict[str, Any] = {
        k: v[rows] for k, v in vars(frames).items() if isinstance(v, np.ndarray)
    }
    return replace(frames, image_paths=tuple(frames.image_paths[i] for i in rows), **columns)


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
    known: set[Path] = set()
    for record in records:
        if record.image_path in known:
            raise InputRefused(
                f"{source}: the frame {record.name!r} is listed twice. Keep one entry. "
                "[capture.duplicate]"
            )
        known.add(record.image_path)
