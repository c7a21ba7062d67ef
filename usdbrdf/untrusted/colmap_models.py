"""COLMAP's models, text or binary, of any version: cameras and poses, by COLMAP's own reader, and
the places of points."""

from __future__ import annotations

import os
import re
import struct
from array import array
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.atomic import raise_shortage
from usdbrdf.files.scratch import scratch_folder
from usdbrdf.model.arrays import Double, Int
from usdbrdf.untrusted.bounds import read_in_child, refuse_large

_SUFFIXES = (".bin", ".txt")  # COLMAP prefers the first
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|[-+]?(?:nan|inf)")
_NEEDED, _NEWER = ("cameras", "images"), ("rigs", "frames")


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """model and parameters as COLMAP names and orders them; resolution is width, height."""

    model: str
    resolution: tuple[int, int]
    parameters: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class ColmapModel:
    """N registered images, by name.

    camera_of_image    (N,) int32 into ``cameras``
    camera_from_world  (N, 3, 4) float64; the camera's x points right, y down, z forward
    """

    names: tuple[str, ...]
    camera_of_image: Int
    camera_from_world: Double
    cameras: tuple[ColmapCamera, ...]


def model_files(folder: Path) -> tuple[Path, ...]:
    """The files of the model that lies in a folder, cameras and images first; () if none does. Of
    rigs and frames one means nothing without the other, and images have poses without both."""
    for suffix in _SUFFIXES:
        needed, newer = (
            tuple(folder / f"{name}{suffix}" for name in names) for names in (_NEEDED, _NEWER)
        )
        if all(file.is_file() for file in needed):
            return (*needed, *newer) if all(file.is_file() for file in newer) else needed
    return ()


def colmap_model(folder: Path) -> ColmapModel:
    """The model in a folder, without its points; InputRefused where it cannot be read."""
    if find_spec("pycolmap") is None:
        raise EnvironmentFailure(
            f"{folder}: COLMAP's models are read with pycolmap, which is not installed. Install "
            "it with: pip install 'usdbrdf[colmap]'. [environment.pycolmap]"
        )
    files = model_files(folder)
    for file in files:
        refuse_large("model", file)
    return read_in_child(
        "model", f"{__name__}:read_here", files[1], ColmapModel, parts=(ColmapCamera,)
    )


def colmap_points(folder: Path) -> Double:
    """(N, 3) the points of the model in a folder; none where their file is not there."""
    file = folder / f"points3D{next(iter(model_files(folder)), Path()).suffix}"
    if not file.is_file():
        return np.empty((0, 3))
    return read_in_child("model", f"{__name__}:read_points_here", file, np.ndarray)


def read_points_here(file: Path) -> Double:
    """``colmap_points`` in this process, which is to be a child. What is cut off ends them."""
    if file.suffix == ".txt":
        with file.open(encoding="utf-8", errors="replace") as lines:
            rows = [line.split(None, 4)[1:4] for line in lines if not line.startswith("#")]
        numbers = [row for row in rows if len(row) == 3 and all(map(_NUMBER.fullmatch, row))]
        return np.array(numbers, np.float64).reshape(-1, 3)
    content, at, points = file.read_bytes(), 8, array("d")
    # Number, place, colour, error, and 8 bytes for each image that shows it.
    layout = struct.Struct("<Q3d3BdQ")
    while at + layout.size <= len(content):
        _, x, y, z, *_, shown = layout.unpack_from(content, at)
        points.extend((x, y, z))
        at += layout.size + 8 * shown
    return np.array(points, np.float64).reshape(-1, 3)


def read_here(images: Path) -> ColmapModel:
    """``colmap_model`` in this process, which is to be a child."""
    import pycolmap

    folder = images.parent
    for file in model_files(folder):
        if file.suffix == ".bin":
            _refuse_promises(file)
    with scratch_folder() as scratch:
        # The points may be many, and are not there in all captures.
        for file in model_files(folder):
            if file.suffix == ".txt":
                _write_plain(file, scratch / file.name)
            else:
                (scratch / file.name).symlink_to(file)
        no_points = struct.pack("<Q", 0) if images.suffix == ".bin" else b"# none\n"
        (scratch / f"points3D{images.suffix}").write_bytes(no_points)
        try:
            model = pycolmap.Reconstruction(str(scratch))
            posed = {i.image_id: i for i in model.images.values() if i.has_pose}
            # By whole names: of one first word, as of "IMG (1).jpg" on, COLMAP knows no order.
            called = _whole_names(images, {n: str(image.name) for n, image in posed.items()})
            numbers = sorted(called, key=lambda n: called[n])
            names, found = tuple(called[n] for n in numbers), [posed[n] for n in numbers]
            poses = [_camera_from_world(image.cam_from_world()) for image in found]
        # COLMAP says what it stumbles over in its own terms, by exceptions of several kinds.
        except Exception as error:
            raise_shortage(error)
            said = " ".join(str(error).split()).replace(str(scratch), str(folder))[:200]
            raise InputRefused(
                f"{folder}: COLMAP cannot read this model ({said}). Export it again. [colmap.model]"
            ) from error
    identifiers = sorted(model.cameras)
    cameras = tuple(
        ColmapCamera(
            model=str(camera.model_name),
            resolution=(int(camera.width), int(camera.height)),
            parameters=tuple(float(number) for number in camera.params),
        )
        for camera in (model.cameras[i] for i in identifiers)
    )
    return ColmapModel(
        names=names,
        camera_of_image=np.array([identifiers.index(image.camera_id) for image in found], np.int32),
        camera_from_world=np.array(poses, np.float64).reshape(-1, 3, 4),
        cameras=cameras,
    )


def _camera_from_world(pose: Any) -> Double:
    """(3, 4); a quaternion of any length is the rotation of its direction, one of 0 none: NaN."""
    length = np.linalg.norm(pose.rotation.quat)
    if not length > 0:
        return np.full((3, 4), np.nan)
    pose.rotation.normalize()
    return np.asarray(pose.matrix(), np.float64)


def _write_plain(file: Path, copy: Path) -> None:
    """A text file of a model as COLMAP expects it: UTF-8 without a mark, each image followed by its
    row of points, which stays empty. Others leave these rows out, or the last of them, and COLMAP
    would take the next image for points, without a word."""
    with (
        file.open(encoding="utf-8-sig", errors="surrogateescape") as lines,
        copy.open("w", encoding="utf-8", errors="surrogateescape") as plain,
    ):
        image_before = False
        for line in lines:
            said = line.strip()
            if not said or said.startswith("#"):
                image_before = image_before and bool(said)
            elif file.stem != "images":
                plain.write(f"{said}\n")
            elif image_before and _is_points(said):
                image_before = False
            else:
                plain.write(f"{said}\n\n")
                image_before = True


def _is_points(said: str) -> bool:
    """Whether a row after an image's is that of its points: places and numbers, in threes."""
    words = said.split()
    return len(words) % 3 == 0 and all(_NUMBER.fullmatch(word) for word in words)


def _whole_names(images: Path, known: dict[int, str]) -> dict[int, str]:
    """The images' names by their numbers, of which ``known`` are. In a text model a name goes on to
    the end of its line; COLMAP itself reads it up to the first space."""
    whole = dict(known)
    if images.suffix != ".txt":
        return whole
    with images.open(encoding="utf-8-sig", errors="replace") as lines:
        for line in lines:
            # Number, pose (7) and camera, before the name; points are rows of numbers alone.
            said = line.strip().split(None, 9)
            if len(said) == 10 and said[0].isdecimal():
                number, name = int(said[0]), said[9]
                if number in known and name.split()[0] == known[number]:
                    whole[number] = name
    return whole


def _refuse_promises(file: Path) -> None:
    """InputRefused where a binary file announces more than it holds: COLMAP would go on counting
    after its end, up to 2^64."""
    walk = {"images": _after_image, "rigs": _after_rig, "frames": _after_frame}.get(file.stem)
    size = file.stat().st_size
    try:
        with file.open("rb") as stored:
            (count,) = _numbers(stored, "<Q")
            if count > size:
                raise EOFError(f"it announces {count} records")
            for _ in range(count if walk else 0):
                assert walk is not None
                walk(stored)
                if stored.tell() > size:
                    raise EOFError("it ends within a record")
    except EOFError as error:
        raise InputRefused(
            f"{file}: COLMAP cannot read this model: {error} in {size} bytes. Export it again. "
            "[colmap.model]"
        ) from error


def _numbers(stored: BinaryIO, layout: str) -> tuple[int, ...]:
    content = stored.read(struct.calcsize(layout))
    if len(content) < struct.calcsize(layout):
        raise EOFError("it ends within a record")
    return struct.unpack(layout, content)


def _after_image(stored: BinaryIO) -> None:
    """Number, pose and camera, a name that ends with 0, and points of 24 bytes."""
    _numbers(stored, "<I7dI")
    while _numbers(stored, "<B") != (0,):
        pass
    (points,) = _numbers(stored, "<Q")
    stored.seek(min(24 * points, 1 << 40), os.SEEK_CUR)


def _after_rig(stored: BinaryIO) -> None:
    """Number, and sensors of type and number; all but the first may have a pose."""
    _, sensors = _numbers(stored, "<II")
    for i in range(sensors):
        _numbers(stored, "<iI")
        if i and _numbers(stored, "<B") != (0,):
            _numbers(stored, "<7d")


def _after_frame(stored: BinaryIO) -> None:
    """Number, rig and pose, and 16 bytes for what each sensor took."""
    *_, taken = _numbers(stored, "<II7dI")
    stored.seek(16 * taken, os.SEEK_CUR)
