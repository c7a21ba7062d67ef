"""A usdbrdf adapter for COLMAP: a text model, scene-linear images, and a mesh.

::

    CAPTURE/
      cameras.txt, images.txt   or in sparse/ or sparse/0/
      images/                   EXR or HDR, as images.txt names them
      mesh.ply                  or another name in MESHES; in the model's frame and unit
      objects.json              optional: the objects' names
"""

from __future__ import annotations

from pathlib import Path

from usdbrdf.capture.checks import Findings, FrameRecord, refuse_photographs
from usdbrdf.capture.formats.transforms import path_in_capture
from usdbrdf.capture.parts import (
    as_photographs,
    geometry_from_file,
    radiance_encoding,
    scan_from_parts,
)
from usdbrdf.errors import InputRefused
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Scan
from usdbrdf.options import IngestOptions
from usdbrdf_colmap.text_model import Image, read_cameras, read_images

NAME = "colmap"
DESCRIPTION = "COLMAP text model (cameras.txt, images.txt), scene-linear images and a mesh"

MODEL_FOLDERS = (".", "sparse", "sparse/0")
# The last two are what COLMAP's own meshers write.
MESHES = ("mesh.ply", "mesh.obj", "mesh.glb", "meshed-poisson.ply", "meshed-delaunay.ply")


def matches(path: Path) -> bool:
    """Whether the folder holds a COLMAP model, as text or binary."""
    return _model(path, ".txt") is not None or _model(path, ".bin") is not None


def read(path: Path, options: IngestOptions) -> Scan:
    """Read and check the capture."""
    path = path.resolve()
    model = _model(path, ".txt")
    if model is None:
        raise InputRefused(
            f"{path}: the COLMAP model is binary or absent. Write it as text with 'colmap "
            "model_converter --output_type TXT'. [colmap.model]"
        )
    findings = Findings()
    cameras = read_cameras(model / "cameras.txt")
    images = read_images(model / "images.txt", cameras)
    records = _records(path, images, cameras, options, findings)
    photographs = refuse_photographs(
        [record.image_path for record in records], assume_srgb=options.assume_srgb
    )
    if photographs:
        records = as_photographs(records, findings, path)
    _warn_of_what_colmap_does_not_know(path, options, findings, photographs=photographs)
    return scan_from_parts(
        records,
        lambda: geometry_from_file(
            options.mesh or _mesh(path),
            options.objects or _objects(path),
            options,
            findings,
            capture_root=path,
        ),
        options,
        findings,
        name=path.name,
        adapter=NAME,
        source=path,
        encoding=radiance_encoding(options, photographs=photographs),
        radiometric=not photographs,
        meters_per_unit=1.0,
        up_axis="Z",
    )


def _model(path: Path, suffix: str) -> Path | None:
    """The folder with the model in the format of ``suffix``."""
    for name in MODEL_FOLDERS:
        folder = path / name
        if all((folder / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
            return folder
    return None


def _records(
    path: Path,
    images: list[Image],
    cameras: dict[int, Camera],
    options: IngestOptions,
    findings: Findings,
) -> list[FrameRecord]:
    """One record per image that exists, by name: COLMAP's own order is that of its threads."""
    records = []
    for image in sorted(images, key=lambda image: image.name):
        # A model is data from elsewhere: its names must not lead out of the capture.
        file = path_in_capture(path, f"images/{image.name}", options)
        if not file.is_file():
            findings.drop(image.name, "the image file does not exist", "capture.file")
            continue
        camera = cameras[image.camera_id]
        records.append(
            FrameRecord(
                name=image.name,
                image_path=file,
                world_from_camera=image.world_from_camera,
                intrinsics=camera.intrinsics,
                resolution=camera.resolution,
            )
        )
    return records


def _mesh(path: Path) -> Path:
    for name in MESHES:
        if (path / name).is_file():
            return path / name
    raise InputRefused(
        f"{path}: no mesh beside the model ({', '.join(MESHES)}). Name one with --mesh. "
        "[colmap.mesh]"
    )


def _objects(path: Path) -> Path | None:
    objects = path / "objects.json"
    return objects if objects.is_file() else None


def _warn_of_what_colmap_does_not_know(
    path: Path, options: IngestOptions, findings: Findings, *, photographs: bool
) -> None:
    if options.meters_per_unit is None or options.up_axis is None:
        findings.warn(
            f"{path.name}: a COLMAP model has no scale and no direction up; taken are metres and "
            "Z. State them with --meters-per-unit and --up-axis. [colmap.scale]"
        )
    if not photographs:
        findings.warn(
            f"{path.name}: a COLMAP model says nothing of exposures, so clipped pixels pass for "
            "radiance. [colmap.saturation]"
        )
