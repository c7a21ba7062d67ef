"""Geometry that comes as USD: it stays where it is and is referenced by the asset."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.scan.findings import Findings
from usdbrdf.scan.ingest_options import IngestOptions
from usdbrdf.scan.scan import ObjectLabel
from usdbrdf.scan.scan_geometry import ScanGeometry
from usdbrdf.stage.foreign import meshes_from_usd
from usdbrdf.stage.naming import unique_identifiers

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
    found = meshes_from_usd(
        path,
        crease_angle_deg=options.crease_angle_deg,
        allow=(capture_root, *options.allow_outside),
    )
    for sentence in found.warnings:
        findings.warn(sentence)
    return ScanGeometry(
        path=path,
        mesh=found.mesh,
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
