"""A usdbrdf adapter for Open3D: a camera trajectory, scene-linear images, and a mesh.

::

    CAPTURE/
      trajectory.json   Open3D's PinholeCameraTrajectory
      images/           EXR or HDR, as many as cameras, in the order of their names
      mesh.ply          or another name in MESHES; in the trajectory's frame and unit
      objects.json      optional: the objects' names
"""

from __future__ import annotations

from pathlib import Path

from usdbrdf.capture.checks import Findings, FrameRecord, refuse_photographs
from usdbrdf.capture.formats.named_pictures import path_in_capture
from usdbrdf.capture.parts import (
    as_photographs,
    geometry_from_file,
    radiance_encoding,
    scan_from_parts,
)
from usdbrdf.errors import InputRefused
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions
from usdbrdf_open3d.trajectory import read_trajectory

NAME = "open3d"
DESCRIPTION = "Open3D camera trajectory (trajectory.json), scene-linear images and a mesh"

DOCUMENT = "trajectory.json"
MESHES = ("mesh.ply", "mesh.obj", "mesh.glb")


def matches(path: Path) -> bool:
    """Whether the folder holds a trajectory."""
    return (path / DOCUMENT).is_file()


def read(path: Path, options: CaptureOptions) -> Scan:
    """Read and check the capture."""
    path = path.resolve()
    findings = Findings()
    records = _records(path, options)
    photographs = refuse_photographs(
        [record.image_path for record in records], assume_srgb=options.assume_srgb
    )
    if photographs:
        records = as_photographs(records, findings, path)
    else:
        findings.warn(
            f"{path.name}: a trajectory says nothing of exposures, so clipped pixels pass for "
            "radiance. [open3d.saturation]"
        )
    objects = path / "objects.json"
    return scan_from_parts(
        records,
        lambda: geometry_from_file(
            options.mesh or _mesh(path),
            options.objects or (objects if objects.is_file() else None),
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


def _records(path: Path, options: CaptureOptions) -> list[FrameRecord]:
    """One record per camera; Open3D names no images, their order is all there is."""
    poses = read_trajectory(path / DOCUMENT)
    folder = path / "images"
    names = sorted(file.name for file in folder.iterdir()) if folder.is_dir() else []
    if len(names) != len(poses):
        raise InputRefused(
            f"{path}: {len(poses)} cameras in {DOCUMENT}, {len(names)} images in images/. Put one "
            "image per camera there, in the order of their names. [open3d.images]"
        )
    return [
        FrameRecord(
            name=name,
            image_path=path_in_capture(path, f"images/{name}", options),
            world_from_camera=pose.world_from_camera,
            intrinsics=pose.intrinsics,
            resolution=pose.resolution,
        )
        for name, pose in zip(names, poses, strict=True)
    ]


def _mesh(path: Path) -> Path:
    for name in MESHES:
        if (path / name).is_file():
            return path / name
    raise InputRefused(
        f"{path}: no mesh beside the trajectory ({', '.join(MESHES)}). Name one with --mesh. "
        "[open3d.mesh]"
    )
