"""ScanNet++: the photographs of dslr/ with the laser scan and the objects of scans/.

dslr/colmap and the mesh share a frame; transforms.json beside it has its axes changed.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.colmap import lens_of, world_from_camera
from usdbrdf.capture.formats.named_pictures import (
    drop_without_picture,
    mesh_beside,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
)
from usdbrdf.capture.formats.scannet_objects import annotated_objects
from usdbrdf.errors import InputRefused
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import colmap_model, model_files

NAME = "scannetpp"
DESCRIPTION = DESCRIPTIONS[NAME]
_MESH = "mesh_aligned_0.05.ply"


def matches(path: Path) -> bool:
    """A scene's folder, with dslr/colmap and scans/."""
    return (path / "scans").is_dir() and bool(model_files(path / "dslr" / "colmap"))


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    source = folder / "dslr" / "colmap"
    if not model_files(source):
        raise InputRefused(
            f"{folder}: no COLMAP model in dslr/colmap. Name the folder of a scene, and download "
            "its DSLR assets. [capture.format]"
        )
    pictures = pictures_of(folder, options, "dslr/resized_images", "dslr/original_images")
    refuse_without_pictures(pictures, source)
    masks = folder / "dslr" / "resized_anon_masks"
    model, records = colmap_model(source), []
    for name, number, pose in zip(
        model.names, model.camera_of_image.tolist(), model.camera_from_world, strict=True
    ):
        image = pictures.named(name)
        if image is None:
            drop_without_picture(name, findings)
            continue
        lens, intrinsics = lens_of(model.cameras[number])
        mask = masks / f"{Path(name).stem}.png"
        records.append(
            FrameRecord(
                name=name,
                image_path=image,
                world_from_camera=world_from_camera(pose),
                intrinsics=intrinsics,
                resolution=model.cameras[number].resolution,
                lens=lens,
                mask_path=mask if mask.is_file() else None,
            )
        )
    warn_of_radiance(pictures.instead, findings, source)
    records.sort(key=lambda record: record.image_path)
    scans = folder / "scans"
    mesh = partial(
        mesh_beside, folder, options, f"scans/{_MESH}", how=f"Download scans/{_MESH} of this scene"
    )
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        name=folder.name,
        objects=annotated_objects(scans / "segments.json", scans / "segments_anno.json"),
    )
