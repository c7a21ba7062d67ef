"""The geometric half of a scan."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from usdbrdf.scan.scan import ObjectLabel, ScanMesh


@dataclass(frozen=True, kw_only=True)
class ScanGeometry:
    """Mesh and objects as in ``Scan``, and the file they came from.

    usd_geometry, object_prims     set if the file is USD and is to be referenced, not copied
    meters_per_unit, up_axis       None where the file does not say
    """

    path: Path
    mesh: ScanMesh
    objects: tuple[ObjectLabel, ...]
    usd_geometry: Path | None = None
    object_prims: tuple[str, ...] = ()
    meters_per_unit: float | None = None
    up_axis: str | None = None
