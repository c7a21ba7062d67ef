"""LLFF: pictures in images/ with poses_bounds.npy, which every NeRF of the first years reads.

A row per picture, in the order of the pictures' names: a 3 x 5 matrix row by row, whose columns are
the camera's axes down, right and backwards, its place, and (height, width, focal length); then the
nearest and the farthest depth. The principal point is the picture's middle.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord
from usdbrdf.capture.formats.named_pictures import (
    FOLDERS,
    pictures_of,
    refuse_without_pictures,
    scan_of,
    warn_of_radiance,
)
from usdbrdf.capture.mesh_frames import mesh_beside
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.capture.up_axis import up_axis_assumed
from usdbrdf.errors import InputRefused
from usdbrdf.files.tables import read_array
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions

NAME = "llff"
DESCRIPTION = DESCRIPTIONS[NAME]
_COLUMNS = (17, 15)  # with the two depths, and without


def matches(path: Path) -> bool:
    """A folder with poses_bounds.npy."""
    return (path / "poses_bounds.npy").is_file()


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    source = folder / "poses_bounds.npy"
    if not source.is_file():
        raise InputRefused(f"{folder}: no poses_bounds.npy. Name its folder. [capture.format]")
    rows = read_array(source)
    if rows.ndim != 2 or rows.shape[1] not in _COLUMNS or rows.dtype.kind not in "fiu":
        raise InputRefused(
            f"{source}: an array of shape {rows.shape}, not one row of 17 numbers per picture. "
            "Write it again with imgs2poses. [capture.format]"
        )
    pictures = pictures_of(folder, options, *FOLDERS[:-1], *_scaled(folder), FOLDERS[-1])
    refuse_without_pictures(pictures, source)
    paths = pictures.paths
    if len(paths) != len(rows):  # photographs and their radiance, or depths, beside each other?
        paths = pictures.of_each_name()
    if len(paths) != len(rows):
        raise InputRefused(
            f"{source}: {len(rows)} poses for {len(pictures.paths)} pictures in "
            f"{pictures.folder.name}. They belong together by their order: bring the pictures that "
            "the poses were made of, all of them and no others. [capture.frames]"
        )
    records = []
    for row, image in zip(rows.astype(np.float64), paths, strict=True):
        down, right, back, centre, (height, width, focal) = row[:15].reshape(3, 5).T
        sound = np.isfinite(row[:15]).all() and min(width, height) >= 1
        if not sound or (width, height) != (round(width), round(height)):
            findings.drop(image.name, "its row holds no finite pose and size", "capture.pose")
            continue
        records.append(
            FrameRecord(
                name=image.name,
                image_path=image,
                world_from_camera=rigid_pose(np.stack([right, -down, back], axis=1), centre),
                intrinsics=(focal, focal, width / 2, height / 2),
                resolution=(int(width), int(height)),
                mask_path=pictures.mask_of(image, folder, options),
            )
        )
    warn_of_radiance(pictures.instead, findings, source)
    if options.meters_per_unit is None:
        findings.warn(
            f"{source.name}: its poses have no scale; taken are metres. State --meters-per-unit. "
            "[capture.unit]"
        )
    mesh = partial(
        mesh_beside,
        folder,
        options,
        how="LLFF has poses and no surface: make a mesh in the same frame, for instance with "
        "COLMAP's dense reconstruction, and put it into this folder",
    )
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        up_axis=up_axis_assumed(records, options, findings, source.name),
    )


def _scaled(folder: Path) -> list[str]:
    """The folders of smaller pictures (images_4, images_1008x756), the largest first; many who pass
    a capture on leave out the pictures that these were made of."""
    found = []
    for place in folder.glob("images_*"):
        if sizes := re.fullmatch(r"images_(\d{1,2})|images_(\d{1,5})x\d{1,5}", place.name):
            factor, width = sizes.groups()
            found.append((factor is None, int(factor) if factor else -int(width), place.name))
    return [name for *_, name in sorted(found)]
