"""E57: pictures taken at the stations of a laser scanner, with their poses, and a mesh beside.

The file holds the pictures inside; they are looked for as files beside it, under the names that
they have there, with _ for what no file may be called. Pinholes look down -z with y up; whole
spheres have x straight ahead and z up.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.named_pictures import (
    Pictures,
    drop_without_picture,
    pictures_of,
    scan_of,
    warn_of_radiance,
)
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.errors import InputRefused
from usdbrdf.files.tables import files_of
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Scan
from usdbrdf.model.lens import PINHOLE, Lens
from usdbrdf.options import CaptureOptions
from usdbrdf.untrusted.e57_files import StationPicture, holds_no_pictures, pictures_of_e57

NAME = "e57"
DESCRIPTION = DESCRIPTIONS[NAME]
# Pixels between principal points that are one: from the corner, or the middle of the first pixel.
_COUNTED = 0.51
_NO_FILE_HAS = re.compile(r'[<>:"/\\|?*]')
# Our camera (x right, y up, looking down -z) in the frame of a sphere (x ahead, y left, z up).
_FLIP = np.array([[0.0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def matches(path: Path) -> bool:
    """An E57 file, or a folder with one of them that holds pictures: laser scans lie beside
    captures of other formats too."""
    return _file_of(path) is not None


def _file_of(path: Path) -> Path | None:
    files = files_of(path, [".e57"])
    if path.is_dir():
        files = [file for file in files if not holds_no_pictures(file)]
    return files[0] if len(files) == 1 else None


def read(path: Path, options: CaptureOptions) -> Scan:
    source = _file_of(path.resolve())
    if source is None:
        raise InputRefused(f"{path}: no E57 file, or several. Name the file. [capture.format]")
    folder, findings = source.parent, Findings()
    taken = pictures_of_e57(source)
    if not taken:
        raise InputRefused(
            f"{source}: an E57 without pictures. Export the stations with their photographs. "
            "[capture.frames]"
        )
    pictures = pictures_of(folder, options)
    if not pictures.paths:
        raise InputRefused(
            f"{source}: its {len(taken)} pictures, first {taken[0].name!r}, are inside the file. "
            "Extract them into a folder images beside it, each under its name (CloudCompare and "
            "e57unpack do), or name the folder with --frames. [capture.frames]"
        )
    records = [
        replace(r, mask_path=pictures.mask_of(r.image_path, folder, options))
        for r in frame_records(taken, pictures, findings)
    ]
    _warn_of_masks(taken, records, findings, source)
    warn_of_radiance(pictures.instead, findings, source)
    mesh = partial(
        mesh_beside,
        folder,
        options,
        "mesh.*",
        how="An E57 holds points: make a mesh of them, for instance in CloudCompare, in the same "
        "frame, and put it beside",
    )
    return scan_of(records, mesh, options, findings, adapter=NAME, source=source, folder=folder)


def frame_records(
    taken: tuple[StationPicture, ...], pictures: Pictures, findings: Findings
) -> list[FrameRecord]:
    """Those of a file's pictures that are there, and whose projection is known."""
    records = []
    for each in taken:
        found = _camera(each)
        if found is None:
            why = f"a {each.kind} picture, or one without pose and size, cannot be projected"
            if each.distortion and not _is_opencv(each):
                why = f"its lens is distorted by a model that is not read ({each.model[:40]!r})"
            findings.drop(each.name, why, "capture.camera")
            continue
        if not each.name:
            findings.drop(
                "a picture", "the E57 gives it no name to find its file by", "capture.file"
            )
            continue
        image = pictures.named(each.name) or pictures.named(_NO_FILE_HAS.sub("_", each.name))
        if image is None:
            drop_without_picture(each.name, findings)
            continue
        lens, intrinsics, pose = found
        records.append(
            FrameRecord(
                name=each.name,
                image_path=image,
                world_from_camera=pose,
                intrinsics=intrinsics,
                resolution=each.resolution,
                lens=lens,
            )
        )
    return records


def _warn_of_masks(
    taken: tuple[StationPicture, ...], records: list[FrameRecord], findings: Findings, source: Path
) -> None:
    """One sentence where masks are inside the file, and none is beside it."""
    unmasked = {record.name for record in records if record.mask_path is None}
    if count := sum(each.is_masked and each.name in unmasked for each in taken):
        findings.warn(
            f"{source.name}: {count} pictures have a mask inside the file (imageMask), which is "
            "not read. Extract it into a folder masks beside it, under the picture's name. "
            "[capture.mask]"
        )


def _camera(each: StationPicture) -> tuple[Lens, tuple[float, float, float, float], Double] | None:
    """Lens, fx, fy, cx, cy and pose; None where the file does not say them."""
    width, height = each.resolution
    pose = each.world_from_camera
    sizes = each.numbers[:3] if each.kind == "pinhole" else each.numbers
    if not sizes or min(*sizes, width, height) <= 0 or not np.isfinite(pose).all():
        return None
    if each.kind == "pinhole":
        focal, across, down, cx, cy = each.numbers
        intrinsics = focal / across, focal / down, cx, cy
        if not each.distortion:
            return PINHOLE, intrinsics, pose
        return (_bent_lens(each), _calibrated(each, intrinsics), pose) if _is_opencv(each) else None
    across, down = each.numbers
    lens = Lens(curve="equirectangular")
    return lens, (1 / across, 1 / down, width / 2, height / 2), pose @ _FLIP


def _is_opencv(each: StationPicture) -> bool:
    return each.model.lower().replace(" ", "") in ("", "opencv")


def _bent_lens(each: StationPicture) -> Lens:
    k1, k2, k3, p1, p2, *divisor = each.distortion
    return Lens(radial=(k1, k2, k3), tangential=(p1, p2), divisor=tuple(divisor))


def _calibrated(
    each: StationPicture, stated: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy that the distortion goes with: those of the pinhole, unless the calibration
    beside it has others by more than its pixels may be counted differently."""
    if not each.calibrated or np.abs(np.subtract(each.calibrated, stated)).max() <= _COUNTED:
        return stated
    fx, fy, cx, cy = each.calibrated
    return fx, fy, cx + 0.5, cy + 0.5  # OpenCV's, from the middle of the first pixel
