"""The capture camera -> the photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom

from usdbrdf.asset.properties import Photographs, facts_of
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames

# The attribute of each field.
_NAMES = {field: fact.attribute() for field, fact in facts_of(Photographs)}


def frames_from_stage(stage: Usd.Stage) -> Frames:
    """The photographs, with poses in metres and absolute image paths, in the order of time."""
    camera = capture_camera(stage)
    prim = camera.GetPrim()
    image = prim.GetAttribute(_NAMES["image"])
    times = image.GetTimeSamples()
    # Row vectors in USD: transposed they are ours.
    poses = np.array([camera.ComputeLocalToWorldTransform(time) for time in times])
    poses = np.ascontiguousarray(poses.transpose(0, 2, 1))
    poses[:, :3, 3] *= UsdGeom.GetStageMetersPerUnit(stage)

    def per_frame(field: str) -> Double:
        attribute = prim.GetAttribute(_NAMES[field])
        return np.array([attribute.Get(time) for time in times], np.float64)

    paths = [asset_file(image, time) for time in times]
    return Frames(
        image_paths=tuple(path for path in paths if path is not None),
        world_from_camera=poses,
        intrinsics=per_frame("intrinsics"),
        resolution=per_frame("resolution").astype(np.int32),
        exposure_time=per_frame("exposure_time"),
        saturation_radiance=per_frame("saturation_radiance"),
        noise_floor_radiance=per_frame("noise_floor_radiance"),
        encoding=str(prim.GetAttribute(_NAMES["encoding"]).Get()),
        radiometric=bool(prim.GetAttribute(_NAMES["radiometric"]).Get()),
    )


def capture_camera(stage: Usd.Stage) -> UsdGeom.Camera:
    """The camera that carries the photographs."""
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Camera) and prim.GetAttribute(_NAMES["image"]):
            return UsdGeom.Camera(prim)
    raise InputRefused(
        f"{stage.GetRootLayer().identifier}: no camera of the stage has photographs "
        "(usdBrdf:capture:image). Run ingest again. [stage.camera]"
    )


def asset_file(attribute: Usd.Attribute, time: Usd.TimeCode | float) -> Path | None:
    """Absolute path of the file that an attribute names, existing or not; None if empty."""
    value = attribute.Get(time)
    if not value or not value.path:
        return None
    # Relative to the layer that holds the opinion.
    layer = attribute.GetPropertyStack(time)[0].layer
    return Path(value.resolvedPath or layer.ComputeAbsolutePath(value.path))
