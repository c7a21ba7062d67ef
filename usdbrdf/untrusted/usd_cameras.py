"""Cameras of a USD stage that somebody else made, read in a child process."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Bool, Double
from usdbrdf.untrusted.usd_files import check_units, render_scene_of_usd

# Attributes that name the picture behind a camera: USD's own back plates, and Houdini's.
_PLATES = ("houdini:backgroundimage", "usdBrdf:capture:image")
_MOST_BETWEEN = 10_000  # times of one camera
# Of a sequence, where its pictures' numbers stand in their names: plate.####.exr, plate.%04d.exr.
_NUMBER = re.compile(r"#+|%0?(\d?)d")
# And the number of one of its pictures: plate.0103.exr.
_OWN_NUMBER = re.compile(r"(?<![0-9])[0-9]{1,9}(?=\.[^.]*$)")
_ROUNDING = 1e-6  # of times that a layer of another rate scales, and of what is interpolated
_SHAPE = "verticalAperture"
_LENS = (
    "focalLength",
    "horizontalAperture",
    _SHAPE,
    "horizontalApertureOffset",
    "verticalApertureOffset",
)


@dataclass(frozen=True, kw_only=True)
class UsdCamera:
    """One camera of a stage at its T time samples; of a camera that does not change, at one, and
    so of one that stands still before one picture.

    path, label        of the prim, and its display name or its own
    times              (T,) time codes; NaN where nothing changes
    sampled            (T,) False at whole times between samples, where USD interpolates
    world_from_camera  (T, 4, 4) as composed, column vectors, in the stage's unit; axes may be
                       scaled
    lens               (T, 5) focal length, horizontal and vertical aperture (NaN where it is
                       left at its default), and their offsets, in one unit
    exposure           (T,) what the exposure attributes multiply radiance by
    images             T absolute paths, existing or not, of sequences those of the times; "" where
                       the camera names none
    """

    path: str
    label: str
    times: Double
    sampled: Bool
    world_from_camera: Double
    lens: Double
    exposure: Double
    images: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class UsdCameras:
    """All perspective cameras of a stage, in its order, and the stage's unit and axis; whether it
    states the unit, or has what USD takes then."""

    cameras: tuple[UsdCamera, ...]
    meters_per_unit: float
    up_axis: str
    states_unit: bool


def cameras_from_usd(path: Path, *, allow: Sequence[Path] = ()) -> UsdCameras:
    """InputRefused where the stage has no perspective camera.

    allow  folders outside the file's own that its asset paths may lead into
    """
    reader = f"{__name__}:read_here"
    parts = (UsdCamera, UsdCameras)
    (found,) = render_scene_of_usd(path, reader, allow=allow, parts=parts)
    assert isinstance(found, UsdCameras)
    return found


def read_here(path: Path) -> tuple[UsdCameras]:
    """``cameras_from_usd`` in this process, which is to be a child."""
    stage = Usd.Stage.Open(str(path), Usd.Stage.LoadAll)
    meters_per_unit, up_axis = check_units(stage, path)
    prims = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate))
    found = [UsdGeom.Camera(prim) for prim in prims if prim.IsA(UsdGeom.Camera)]
    perspective = UsdGeom.Tokens.perspective
    sound = [c for c in found if c.GetProjectionAttr().Get() in (None, perspective)]
    if not sound:
        what = f"{len(found)} cameras, none of them perspective" if found else "no camera"
        raise InputRefused(
            f"{path}: {what}. Export the cameras of the photographs with the stage. [stage.camera]"
        )
    cameras = tuple(_camera(camera) for camera in sound)
    return (
        UsdCameras(
            cameras=cameras,
            meters_per_unit=meters_per_unit,
            up_axis=up_axis,
            states_unit=UsdGeom.StageHasAuthoredMetersPerUnit(stage),
        ),
    )


def _camera(camera: UsdGeom.Camera) -> UsdCamera:
    prim = camera.GetPrim()
    plates = map(prim.GetAttribute, _names_of_plates(prim))
    plate = next((a for a in plates if any(map(_is_path, _values(a)))), None)
    sampled, between = _times_of(camera, plate)
    known = {*map(_whole, sampled)}
    times = sorted({*sampled, *(time for time in between if time not in known)})
    codes = [Usd.TimeCode(time) for time in times] or [Usd.TimeCode.EarliestTime()]
    said = [name for name in _LENS if name != _SHAPE or prim.GetAttribute(name).IsAuthored()]
    lens = [
        [_number(prim.GetAttribute(name).Get(code)) if name in said else np.nan for name in _LENS]
        for code in codes
    ]
    # Row vectors in USD: transposed they are ours.
    poses = [np.array(camera.ComputeLocalToWorldTransform(code)).T for code in codes]
    exposure = [camera.ComputeLinearExposureScale(code) for code in codes]
    files = [_file_of(plate, code) if plate else "" for code in codes]
    named = next(filter(None, files), "")
    one = named and {*files} <= {named, ""} and not _is_sequence(named)
    if one and _is_one(poses) and _is_one(lens) and _is_one(exposure):
        times, files = [], [named]  # as programs do that write all at every time
        poses, lens, exposure = poses[:1], lens[:1], exposure[:1]
    return UsdCamera(
        path=str(prim.GetPath()),
        label=prim.GetDisplayName() or prim.GetName(),
        times=np.array([*map(_whole, times)] or [np.nan], np.float64),
        sampled=np.array([time in sampled for time in times] or [True], np.bool_),
        world_from_camera=np.array(poses, np.float64),
        lens=np.array(lens, np.float64),
        exposure=np.array(exposure, np.float64),
        images=_images(files, [*map(_whole, times)]) if times else tuple(files),
    )


def _whole(time: float) -> float:
    """The time, but for rounding."""
    whole = float(round(time)) if math.isfinite(time) else time
    return whole if abs(time - whole) < _ROUNDING else time


def _is_one(rows: Sequence[Any]) -> bool:
    """Whether what a camera has at several times is one and the same, but for rounding."""
    return bool(np.allclose(rows, rows[0], _ROUNDING, _ROUNDING, equal_nan=True))


def _names_of_plates(prim: Usd.Prim) -> list[str]:
    own = [str(attribute.GetName()) for attribute in prim.GetAuthoredAttributes()]
    plates = [name for name in own if name.startswith("backPlate:") and name.count(":") == 2]
    return [name for name in plates if name.endswith(":image")] + [n for n in _PLATES if n in own]


def _values(plate: Usd.Attribute) -> list[object]:
    """What an attribute names at any time."""
    codes = map(Usd.TimeCode, plate.GetTimeSamples())
    return [plate.Get(code) for code in [*codes, Usd.TimeCode.EarliestTime()]]


def _times_of(camera: UsdGeom.Camera, plate: Any) -> tuple[list[float], Sequence[float]]:
    """When the camera names another picture, and nothing between, where one name lasts until the
    next; else when it, or what it hangs on, moves or zooms, and whole times between."""
    named = set(plate.GetTimeSamples()) if plate and plate.GetNumTimeSamples() > 1 else set()
    if named and not any(_is_sequence(_file_of(plate, Usd.TimeCode(t))) for t in named):
        return sorted(named), ()
    prim = camera.GetPrim()
    times = named.union(*(prim.GetAttribute(name).GetTimeSamples() for name in _LENS))
    while prim and not prim.IsPseudoRoot():
        moving = UsdGeom.Xformable(prim)
        times |= set(moving.GetTimeSamples() if moving else ())
        prim = prim.GetParent()
    sampled = sorted(times) if len(times) > 1 else []
    return sampled, _times_between(camera, sampled)


def _times_between(camera: UsdGeom.Camera, sampled: Sequence[float]) -> Sequence[float]:
    """Whole times between samples that leave some out, as those of animators and of exporters that
    write no more than they must; none where a matrix is sampled, as nothing between two of these is
    a pose."""
    if not sampled or not sampled[-1] - sampled[0] < _MOST_BETWEEN:
        return ()
    prim = camera.GetPrim()
    while prim and not prim.IsPseudoRoot():
        for op in UsdGeom.Xformable(prim).GetOrderedXformOps() if UsdGeom.Xformable(prim) else ():
            if op.GetOpType() == UsdGeom.XformOp.TypeTransform and op.GetNumTimeSamples() > 1:
                return ()
        prim = prim.GetParent()
    return range(math.ceil(sampled[0]), math.floor(sampled[-1]) + 1)


def _images(files: Sequence[str], times: Sequence[float]) -> tuple[str, ...]:
    """The picture of each time, of what is named at these: one of a name that lasts where that
    begins, each of a sequence at its number; "" at other times."""
    if len(set(files)) > 1:
        begun = zip(files, ["", *files], times, strict=False)
        return tuple(
            _at_time(file, time) if file != before or _is_sequence(file) else ""
            for file, before, time in begun
        )
    # One name for many times may be that of one picture of a sequence, by its number.
    folder, name = os.path.split(files[0])
    number = _OWN_NUMBER.search(name)
    if len(times) > 1 and number and int(number[0]) in times:
        before, after = name[: number.start()], name[number.end() :]
        numbers = ["" if t % 1 else f"{int(t)}".zfill(len(number[0])) for t in times]
        return tuple(n and os.path.join(folder, before + n + after) for n in numbers)
    return tuple(map(_at_time, files, times))


def _is_sequence(file: str) -> bool:
    """Whether a file's name stands for many; one that is there is no more than that."""
    return bool(_NUMBER.search(os.path.basename(file))) and not os.path.isfile(file)


def _at_time(file: str, time: float) -> str:
    """The file, of a sequence the one of this number; "" at times between its pictures."""
    if not _is_sequence(file):
        return file
    folder, name = os.path.split(file)

    def numbered(found: re.Match[str]) -> str:
        return f"{int(time)}".zfill(int(found[1] or 1) if found[0][0] == "%" else len(found[0]))

    return os.path.join(folder, _NUMBER.sub(numbered, name)) if time % 1 == 0 else ""


def _file_of(plate: Usd.Attribute, code: Usd.TimeCode) -> str:
    """Absolute path, existing or not, relative to the layer that holds the opinion."""
    value = plate.Get(code)
    if not _is_path(value):
        return ""
    layer = plate.GetPropertyStack(code)[0].layer
    named = value.resolvedPath or layer.ComputeAbsolutePath(value.path)
    # What is named without a leading ./ and not there stays as it is named.
    return os.path.join(os.path.dirname(str(layer.realPath)), str(named))


def _is_path(value: object) -> bool:
    """Whether an attribute's value is a path; a file may have given it any type."""
    return isinstance(value, Sdf.AssetPath) and bool(value.path)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
