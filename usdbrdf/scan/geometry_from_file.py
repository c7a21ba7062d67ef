"""The scan's mesh and objects, from whatever file holds them."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.geometry.mesh_clean import clean_mesh
from usdbrdf.geometry.mesh_from_file import mesh_from_file
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.scan.findings import Findings
from usdbrdf.scan.geometry_from_usd import USD_SUFFIXES, geometry_from_usd
from usdbrdf.scan.ingest_options import IngestOptions
from usdbrdf.scan.objects_from_labels import label_table, objects_with_faces, segmentation
from usdbrdf.scan.scan import ScanMesh
from usdbrdf.scan.scan_geometry import ScanGeometry


def geometry_from_file(
    mesh_path: Path,
    objects_path: Path | None,
    options: IngestOptions,
    findings: Findings,
    *,
    capture_root: Path,
    meters_per_unit: float,
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
        path=mesh_path,
        mesh=ScanMesh(
            points=clean.points,
            triangles=clean.triangles,
            corner_normals=corner_normals(clean.points, clean.triangles, options.crease_angle_deg),
            face_object=face_object,
        ),
        objects=objects,
    )
