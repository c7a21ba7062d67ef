"""ScanNet++: the photographs of dslr/, else of iphone/, with the mesh and the objects of scans/.

The COLMAP models and the mesh share a frame; transforms.json beside them has its axes changed, so
of that of undistorted photographs the lens alone is read.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.colmap import lens_of, world_from_camera
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    drop_without_picture,
    mesh_beside,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
)
from usdbrdf.capture.formats.scannet_objects import annotated_objects
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import ColmapCamera, colmap_model, model_files

NAME = "scannetpp"
DESCRIPTION = DESCRIPTIONS[NAME]
_MESH = "mesh_aligned_0.05.ply"
_MODELS = ("dslr/colmap", "iphone/colmap")
# Pictures of each model, and what masks them: the first folder that holds any is taken. The last of
# the undistorted ones are called as the dataset's own tool calls them by default.
_PICTURES = {
    "dslr/colmap": {
        "dslr/resized_images": "dslr/resized_anon_masks",
        "dslr/original_images": "dslr/original_anon_masks",
        "dslr/resized_undistorted_images": "dslr/resized_undistorted_masks",
        "dslr/undistorted_images": "dslr/undistorted_anon_masks",
    },
    "iphone/colmap": {"iphone/rgb": "iphone/rgb_masks"},
}
_SAID = "nerfstudio/transforms.json"
_UNDISTORTED = "nerfstudio/transforms_undistorted.json"


def matches(path: Path) -> bool:
    """A scene's folder, with scans/ and dslr/colmap, or iphone/colmap."""
    return (path / "scans").is_dir() and any(model_files(path / model) for model in _MODELS)


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    there = [model for model in _MODELS if model_files(folder / model)]
    if not there:
        raise InputRefused(
            f"{folder}: no COLMAP model in dslr/colmap. Name the folder of a scene, and download "
            "its DSLR assets. [capture.format]"
        )
    found = {model: pictures_of(folder, options, *_PICTURES[model]) for model in there}
    chosen = next((model for model in there if found[model].paths), there[0])
    source, pictures = folder / chosen, found[chosen]
    if not pictures.paths and chosen == "iphone/colmap":
        raise InputRefused(
            f"{source}: no pictures in iphone/rgb. Extract those of rgb.mkv with the dataset's "
            "iphone/prepare_iphone_data.py, or download the scene's DSLR assets. [capture.frames]"
        )
    refuse_without_pictures(pictures, source)
    masks = _masks_of(pictures, folder, chosen)
    model, records = colmap_model(source), []
    lenses = _lenses(pictures, source, model.cameras)
    bad = _bad(source.parent / _SAID)
    for name, number, pose in zip(
        model.names, model.camera_of_image.tolist(), model.camera_from_world, strict=True
    ):
        if PurePosixPath(name).name in bad:
            findings.count("frames_said_to_be_bad", 1)
            continue
        image = pictures.named(name)
        if image is None:
            drop_without_picture(name, findings)
            continue
        lens, intrinsics, resolution = lenses[number]
        mask = masks / f"{Path(name).stem}.png"
        records.append(
            FrameRecord(
                name=name,
                image_path=image,
                world_from_camera=world_from_camera(pose),
                intrinsics=intrinsics,
                resolution=resolution,
                lens=lens,
                mask_path=mask if mask.is_file() else None,
            )
        )
    if left := findings.counts.get("frames_said_to_be_bad"):
        findings.warn(
            f"{source.parent.name}: {left} of {len(model.names)} frames are left out, of which "
            f"{_SAID} says is_bad. [capture.image]"
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


def _bad(document: Path) -> set[str]:
    """Names of the photographs of which the dataset says that they are blurred."""
    said: Any = read_json(document) if document.is_file() else {}
    lists = [said.get(key) for key in ("frames", "test_frames")] if isinstance(said, dict) else []
    rows = [row for rows in lists if isinstance(rows, list) for row in rows]
    bad = [row for row in rows if isinstance(row, dict) and row.get("is_bad") is True]
    return {PurePosixPath(str(row.get("file_path", ""))).name for row in bad}


def _masks_of(pictures: Pictures, folder: Path, model: str) -> Path:
    """The folder of what masks these pictures; of pictures elsewhere, that of the model's first."""
    usual = {folder / name: folder / masks for name, masks in _PICTURES[model].items()}
    return usual.get(pictures.folder, next(iter(usual.values())))


_Through = tuple[Lens, tuple[float, float, float, float], tuple[int, int]]


def _lenses(pictures: Pictures, source: Path, cameras: tuple[ColmapCamera, ...]) -> list[_Through]:
    """Lens, fx, fy, cx, cy and size of each camera of the model; of undistorted pictures those that
    were written with them."""
    if "undistort" not in pictures.folder.name.lower():
        return [(*lens_of(camera), camera.resolution) for camera in cameras]
    document = source.parent / _UNDISTORTED
    if not document.is_file():
        raise InputRefused(
            f"{document}: not there, and {pictures.folder.name} holds undistorted pictures, whose "
            "lens it states. Bring it, or the pictures of resized_images. [capture.camera]"
        )
    said: Any = read_json(document)
    try:
        numbers = [float(said[key]) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")]
        if said["camera_model"] != "PINHOLE" or min(numbers) <= 0:
            raise ValueError
        fx, fy, cx, cy, width, height = numbers
        pinhole = PINHOLE, (fx, fy, cx, cy), (int(width), int(height))
    except (KeyError, OverflowError, TypeError, ValueError):
        raise InputRefused(
            f"{document}: does not state a PINHOLE by fl_x, fl_y, cx, cy, w and h. Write it anew "
            "with the dataset's dslr/undistort.py. [capture.camera]"
        ) from None
    return [pinhole] * len(cameras)
