"""The HDR rooms of FIPT (Wu et al. 2023), photographed and rendered.

Photographed: Image/000_0001.exr, cam.txt with three lines per camera (origin, a point looked at,
up), K_list.txt with the three rows of K per camera, scene.obj, segmentation/000.exr.
Rendered: train/ and val/, each with Image/ and transforms.json, whose cameras have x to the left,
y up and look down +z; scene.obj above them.

Objects are where most pixels of the segmentation that see a face agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.capture.adapters import DESCRIPTIONS
from usdbrdf.capture.checks import Findings, FrameRecord, clause_of
from usdbrdf.capture.formats.named_pictures import Pictured, scan_of
from usdbrdf.capture.mesh_frames import LabelTable, mesh_beside
from usdbrdf.capture.rigid_poses import rigid_pose
from usdbrdf.capture.up_axis import up_axis_assumed
from usdbrdf.errors import ImageRefused, InputRefused
from usdbrdf.files.documents import read_json
from usdbrdf.files.images import image_size, read_exr
from usdbrdf.files.tables import number_rows
from usdbrdf.model.arrays import Double, Long
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Scan
from usdbrdf.options import CaptureOptions
from usdbrdf.transport.rays import RayScene
from usdbrdf.untrusted.mesh_files import FileMesh

NAME = "fipt"
DESCRIPTION = DESCRIPTIONS[NAME]
_SPLITS = ("train", "val")
# Every so many pixels of the segmentation vote, along both sides.
_STRIDE = 4
_HOW = "The data set has its surface as scene.obj: put it into this folder"


def matches(path: Path) -> bool:
    """cam.txt with K_list.txt, or train/ with transforms.json and Image/."""
    photographed = (path / "cam.txt").is_file() and (path / "K_list.txt").is_file()
    train = path / "train"
    return photographed or ((train / "transforms.json").is_file() and (train / "Image").is_dir())


def read(path: Path, options: CaptureOptions) -> Scan:
    folder, findings = path.resolve(), Findings()
    pictured = Pictured(folder=folder, options=options)
    if (folder / "cam.txt").is_file():
        source, records = folder / "cam.txt", _photographed(pictured, findings)
    elif (folder / "train").is_dir():
        source, records = folder / "train" / "transforms.json", _rendered(pictured, findings)
    else:
        raise InputRefused(
            f"{folder}: neither cam.txt nor train/transforms.json. Name the scene's folder. "
            "[capture.format]"
        )
    mesh = partial(mesh_beside, folder, options, "scene.obj", "scene.ply", how=_HOW)
    segmentations = [_segmentation_of(pictured, record) for record in records]
    pictured.warn_of_others(findings, source)
    segmented = any(map(Path.is_file, segmentations))
    return scan_of(
        records,
        mesh,
        options,
        findings,
        adapter=NAME,
        source=source,
        folder=folder,
        up_axis=up_axis_assumed(records, options, findings, source.name),
        objects=_voted(records, segmentations) if segmented else None,
    )


def _photographed(pictured: Pictured, findings: Findings) -> list[FrameRecord]:
    folder = pictured.folder
    cameras, lenses = _triples(folder / "cam.txt"), _triples(folder / "K_list.txt")
    if len(cameras) != len(lenses):
        raise InputRefused(
            f"{folder / 'K_list.txt'}: {len(lenses)} lenses for {len(cameras)} cameras of cam.txt. "
            "Bring both of one capture. [capture.format]"
        )
    records = []
    for i, (camera, lens) in enumerate(zip(cameras, lenses, strict=True)):
        image = f"Image/{i:03d}_0001.exr"
        origin, target, up = camera
        ahead = (target - origin) / (np.linalg.norm(target - origin) or 1.0)
        # Up is of three decimals in some files, or only roughly up: made square to the view.
        right = np.cross(ahead, up)
        right /= np.linalg.norm(right) or 1.0
        axes = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
        record = _record(pictured, image, rigid_pose(axes, origin), lens, findings)
        records += [record] if record else []
    return records


def _triples(path: Path) -> Double:
    """(N, 3, 3): the number of cameras, then three rows of three numbers for each."""
    if not path.is_file():
        raise InputRefused(f"{path}: missing. Bring it from the data set. [capture.format]")
    head, *rows = number_rows(path) or (np.zeros(0),)
    if len(head) != 1 or any(len(row) != 3 for row in rows) or len(rows) != 3 * head[0]:
        raise InputRefused(
            f"{path}: not the number of cameras and three rows of three numbers for each. Bring "
            "it from the data set again. [capture.format]"
        )
    return np.array(rows).reshape(-1, 3, 3)


def _rendered(pictured: Pictured, findings: Findings) -> list[FrameRecord]:
    folder, records = pictured.folder, []
    for split in _SPLITS:
        path = folder / split / "transforms.json"
        if not path.is_file():
            continue
        document: Any = read_json(path)
        frames = document.get("frames") if isinstance(document, dict) else None
        angle = document.get("camera_angle_x") if isinstance(document, dict) else None
        if not isinstance(frames, list) or not isinstance(angle, float) or not 0 < angle < math.pi:
            raise InputRefused(
                f"{path}: no frames with a camera_angle_x. Bring it from the data set again. "
                "[capture.format]"
            )
        for i, frame in enumerate(frames):
            image = f"{split}/Image/{i:03d}_0001.exr"
            try:
                pose = np.array(frame["transform_matrix"], np.float64)
                pose = np.vstack([pose[:3, :4], [0, 0, 0, 1]])
            except (KeyError, TypeError, ValueError, IndexError):
                findings.drop(image, "it has no 4 x 4 pose", "capture.pose")
                continue
            # From x left, y up, looking down +z: half a turn about y.
            pose = pose @ np.diag([-1.0, 1, -1, 1])
            record = _record(pictured, image, pose, angle, findings)
            records += [record] if record else []
    return records


def _record(
    pictured: Pictured, name: str, pose: Double, lens: Double | float, findings: Findings
) -> FrameRecord | None:
    """lens is K, or the angle of view across."""
    image = pictured.of(name)
    if image is None:
        findings.drop(name, "the image file does not exist", "capture.file")
        return None
    try:
        width, height, _ = image_size(image)
    except ImageRefused as error:
        findings.drop(name, clause_of(error, image), "capture.image")
        return None
    if isinstance(lens, float):
        focal = width / 2 / math.tan(lens / 2)
        intrinsics = (focal, focal, width / 2, height / 2)
    else:
        intrinsics = (lens[0, 0], lens[1, 1], lens[0, 2], lens[1, 2])
    return FrameRecord(
        name=name,
        image_path=image,
        world_from_camera=pose,
        intrinsics=intrinsics,
        resolution=(width, height),
        size_of_image=True,
    )


def _segmentation_of(pictured: Pictured, record: FrameRecord) -> Path:
    folder, number = record.name.split("Image/")
    return pictured.file(f"{folder}segmentation/{number.partition('_')[0]}.exr")


def _voted(
    records: Sequence[FrameRecord], segmentations: Sequence[Path]
) -> Callable[[FileMesh], LabelTable]:
    def objects(mesh: FileMesh) -> LabelTable:
        scene = RayScene(mesh.points, mesh.triangles)
        segmented = zip(records, segmentations, strict=True)
        votes = [vote for record, path in segmented for vote in _votes(record, path, scene)]
        if not votes:
            return LabelTable({}, None)
        face, number = (np.concatenate(each) for each in zip(*votes, strict=True))
        label = np.full(len(mesh.triangles), -1, np.int64)
        pairs, count = np.unique(np.stack([face, number]), axis=1, return_counts=True)
        order = np.argsort(count, kind="stable")  # the most frequent is written last
        label[pairs[0, order]] = pairs[1, order]
        return LabelTable({}, label)

    return objects


def _votes(record: FrameRecord, path: Path, scene: RayScene) -> list[tuple[Long, Long]]:
    """Faces, and the number that a pixel which sees each has."""
    if not path.is_file():
        return []
    number = read_exr(path)[..., 0]
    height, width = number.shape
    camera = Camera(
        world_from_camera=record.world_from_camera,
        intrinsics=record.intrinsics,
        width=record.resolution[0],
        height=record.resolution[1],
    ).at_size(width, height)
    pixels = camera.pixels(_STRIDE)
    face = scene.closest(*camera.rays(pixels)).face.astype(np.int64)
    column, row = pixels.astype(np.int64).T
    seen = number[row, column]
    known = (face >= 0) & np.isfinite(seen) & (seen >= 0)
    return [(face[known], np.rint(seen[known]).astype(np.int64))]
