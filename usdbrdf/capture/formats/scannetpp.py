"""ScanNet++: the photographs of dslr/, else of iphone/, with the mesh and the objects of scans/.

The COLMAP models and the mesh share a frame; transforms.json beside them has its axes changed. It
is read where there is no model; where there is, the lens of undistorted photographs alone.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.colmap import lens_of, world_from_camera
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    drop_without_picture,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
)
from usdbrdf.capture.formats.nerfstudio_frames import TESTED, is_bad, warn_of_bad
from usdbrdf.capture.formats.scannet_objects import annotated_objects
from usdbrdf.capture.formats.transforms import records_of_scene
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.colmap_models import ColmapCamera, colmap_model, model_files

NAME = "scannetpp"
DESCRIPTION = DESCRIPTIONS[NAME]
_MESH = "mesh_aligned_0.05.ply"
# Pictures of each camera, and what masks them: the first folder that holds any is taken. The last
# of the undistorted ones are called as the dataset's own tool calls them by default.
_PICTURES = {
    "dslr": {
        "dslr/resized_images": "dslr/resized_anon_masks",
        "dslr/original_images": "dslr/original_anon_masks",
        "dslr/resized_undistorted_images": "dslr/resized_undistorted_masks",
        "dslr/undistorted_images": "dslr/undistorted_anon_masks",
    },
    "iphone": {"iphone/rgb": "iphone/rgb_masks"},
}
_SAID = "nerfstudio/transforms.json"
_UNDISTORTED = "nerfstudio/transforms_undistorted.json"


def matches(path: Path) -> bool:
    """A scene's folder, with scans/, and poses in dslr/ or iphone/."""
    return (path / "scans").is_dir() and bool(_posed(path))


def _posed(scene: Path) -> list[str]:
    """The cameras whose poses are there: first those with COLMAP models, then those with documents
    alone."""
    models = [camera for camera in _PICTURES if model_files(scene / camera / "colmap")]
    said = ((c, scene / c / name) for c in _PICTURES for name in (_SAID, _UNDISTORTED))
    return list(dict.fromkeys([*models, *(camera for camera, path in said if path.is_file())]))


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    there = _posed(folder)
    if not there:
        raise InputRefused(
            f"{folder}: no COLMAP model in dslr/colmap, and no dslr/{_SAID}. Name the folder of a "
            "scene, and download its DSLR assets. [capture.format]"
        )
    found = {camera: pictures_of(folder, options, *_PICTURES[camera]) for camera in there}
    # Those of --frames may be any camera's.
    at_home = [c for c in there if found[c].folder.is_relative_to(folder / c)]
    camera = next((c for c in (*at_home, *there) if found[c].paths), there[0])
    place, pictures = folder / camera, found[camera]
    if not pictures.paths and camera == "iphone":
        raise InputRefused(
            f"{place}: no pictures in iphone/rgb. Extract those of rgb.mkv with the dataset's "
            "iphone/prepare_iphone_data.py, or download the scene's DSLR assets. [capture.frames]"
        )
    refuse_without_pictures(pictures, place)
    if model_files(place / "colmap"):
        source = place / "colmap"
        records = _of_model(source, pictures, findings)
    else:
        source = _document_of(place, pictures)
        records = records_of_scene(source, pictures.folder, options, findings)
    masks = _masks_of(pictures, folder, camera)
    records = [_with_mask(record, masks) for record in records]
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


def _of_model(source: Path, pictures: Pictures, findings: Findings) -> list[FrameRecord]:
    """The frames of a COLMAP model, without masks."""
    model, records = colmap_model(source), list[FrameRecord]()
    lenses = _lenses(pictures, source, model.cameras)
    bad, left = _bad(source.parent / _SAID), 0
    for name, number, pose in zip(
        model.names, model.camera_of_image.tolist(), model.camera_from_world, strict=True
    ):
        if PurePosixPath(name).name in bad:
            left += 1
            continue
        image = pictures.named(name)
        if image is None:
            drop_without_picture(name, findings)
            continue
        lens, intrinsics, resolution = lenses[number]
        records.append(
            FrameRecord(
                name=name,
                image_path=image,
                world_from_camera=world_from_camera(pose),
                intrinsics=intrinsics,
                resolution=resolution,
                lens=lens,
            )
        )
    warn_of_bad(left, len(model.names), f"{source.parent.name}/{_SAID}", findings)
    warn_of_radiance(pictures.instead, findings, source)
    return records


def _document_of(place: Path, pictures: Pictures) -> Path:
    """The document whose poses and lens are those of these pictures."""
    name = _UNDISTORTED if _are_undistorted(pictures) else _SAID
    if not (place / name).is_file():
        raise InputRefused(
            f"{place / name}: not there, nor a COLMAP model, and {pictures.folder.name} holds "
            "pictures of which it states the lens. Download it. [capture.camera]"
        )
    return place / name


def _are_undistorted(pictures: Pictures) -> bool:
    return "undistort" in pictures.folder.name.lower()


def _bad(document: Path) -> set[str]:
    """Names of the photographs of which the dataset says that they are blurred."""
    said: Any = read_json(document) if document.is_file() else {}
    lists = [said.get(key) for key in ("frames", TESTED)] if isinstance(said, dict) else []
    rows = [row for rows in lists if isinstance(rows, list) for row in rows]
    bad = [row for row in rows if isinstance(row, dict) and is_bad(row)]
    return {PurePosixPath(str(row.get("file_path", ""))).name for row in bad}


def _masks_of(pictures: Pictures, folder: Path, camera: str) -> Path:
    """The folder of what masks these pictures; of pictures elsewhere, the camera's first."""
    usual = {folder / name: folder / masks for name, masks in _PICTURES[camera].items()}
    return usual.get(pictures.folder, next(iter(usual.values())))


def _with_mask(record: FrameRecord, masks: Path) -> FrameRecord:
    mask = masks / f"{PurePosixPath(record.name).stem}.png"
    return replace(record, mask_path=mask if mask.is_file() else None)


_Through = tuple[Lens, tuple[float, float, float, float], tuple[int, int]]


def _lenses(pictures: Pictures, source: Path, cameras: tuple[ColmapCamera, ...]) -> list[_Through]:
    """Lens, fx, fy, cx, cy and size of each camera of the model; of undistorted pictures those that
    were written with them."""
    if not _are_undistorted(pictures):
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
