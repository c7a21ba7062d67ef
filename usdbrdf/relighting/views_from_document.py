"""A nerfstudio document (transforms.json, views.json) -> views in the asset's world."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.capture.checks import rigid_records
from usdbrdf.capture.findings import Findings
from usdbrdf.capture.transforms import frame_records
from usdbrdf.errors import InputRefused
from usdbrdf.model.camera import Camera
from usdbrdf.options import IngestOptions


def views_from_document(source: Path, asset: Asset, metres_per_unit: float) -> tuple[Camera, ...]:
    """The views of a document of the asset's capture, named after their images.

    Poses are in the capture's frame and unit and are treated as ingest treated those of the
    capture; images need not exist where the document states width and height. InputRefused where
    one of them cannot be used or two would have the same name.
    """
    findings = Findings()
    records = frame_records(source, IngestOptions(), findings, images=False)
    pose_scale = read_provenance(asset.layer("scan")).get("parameters", {}).get("pose_scale")
    records = rigid_records(records, findings, source, pose_scale=pose_scale)
    if findings.dropped:
        first = findings.dropped[0]
        raise InputRefused(
            f"{source}: the view {first.name!r} cannot be rendered: {first.reason}. Correct the "
            "document. [relight.views]"
        )
    stems = [Path(record.name).stem for record in records]
    if not records or len(set(stems)) < len(stems):
        raise InputRefused(
            f"{source}: {'no views' if not records else 'two views have images of one name'}. "
            "Correct the document. [relight.views]"
        )
    views = []
    for record in records:
        pose = record.world_from_camera.copy()
        pose[:3, 3] *= metres_per_unit
        width, height = record.resolution
        views.append(
            Camera(
                name=record.name,
                world_from_camera=pose,
                intrinsics=record.intrinsics,
                width=width,
                height=height,
            )
        )
    return tuple(views)
