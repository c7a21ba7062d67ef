"""The photographs as one UsdGeomCamera with a time code per frame."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf

from usdbrdf.asset.layers.author import (
    apply_schema,
    attribute,
    attribute_per_frame,
    author_fact,
    define,
)
from usdbrdf.asset.layout import is_storable
from usdbrdf.asset.properties import Photographs, known_facts
from usdbrdf.errors import InputRefused
from usdbrdf.model.arrays import Double
from usdbrdf.model.capture import Frames

Types = Sdf.ValueTypeNames

APERTURE_MM = 36.0

NEAR_M, FAR_M = 0.01, 1000.0

_PLATE = "photograph"


def author_capture_camera(
    layer: Sdf.Layer,
    path: str,
    frames: Frames,
    meters_per_unit: float,
    folder: Path,
    *,
    reset_transform: bool = False,
) -> None:
    """Define the camera; frame i is at time code i + 1, and the first is the default as well.

    folder           where the layer will lie: the photographs' paths are relative to it
    reset_transform  the poses are in the world, whatever the camera's ancestors do
    """
    prim = define(layer, path, "Camera")
    _author_pose(prim, frames.world_from_camera, reset_transform)
    _author_lens(prim, frames, meters_per_unit)
    _author_exposure(prim, frames.exposure_time)
    _author_capture(prim, frames, folder)


def relative_path(target: Path, folder: Path) -> str:
    """Path from ``folder`` to a file, anchored and with forward slashes.

    Folders are resolved first: ``..`` above a symbolic link would lead elsewhere. The file itself
    may be a link and stays one.
    """
    target = Path(os.path.realpath(target.parent)) / target.name
    relative = os.path.relpath(target, os.path.realpath(folder)).replace(os.sep, "/")
    return relative if relative.startswith("../") else f"./{relative}"


def storable_path(target: Path, folder: Path) -> str:
    """The same; refuses names that USD cannot hold."""
    if not is_storable(target):
        raise InputRefused(
            f"{str(target)!r}: the name holds characters that USD cannot store in a path. "
            "Rename the file. [stage.asset_path]"
        )
    return relative_path(target, folder)


def lens_from_pinhole(
    pinhole: Double, resolution: Sequence[int], meters_per_unit: float
) -> tuple[float, float, float, float, float]:
    """focalLength, horizontal and vertical aperture, horizontal and vertical offset.

    In tenths of a scene unit, as USD wants them. Only ratios to the aperture mean anything, so the
    aperture is that of a full-frame camera.
    """
    fx, fy, cx, cy = (float(value) for value in pinhole)
    width, height = (int(value) for value in resolution)
    aperture = APERTURE_MM / (100.0 * meters_per_unit)
    focal = fx * aperture / width
    vertical = focal * height / fy
    offset_x = (width / 2 - cx) * aperture / width
    offset_y = (cy - height / 2) * vertical / height
    return focal, aperture, vertical, offset_x, offset_y


def _author_pose(prim: Sdf.PrimSpec, world_from_camera: Double, reset_transform: bool) -> None:
    # USD multiplies row vectors from the left: its matrices are ours transposed.
    poses = [Gf.Matrix4d(pose.T.tolist()) for pose in np.asarray(world_from_camera, np.float64)]
    name = "xformOp:transform"
    attribute_per_frame(prim, name, Types.Matrix4d, poses, always=True)
    order = ["!resetXformStack!", name] if reset_transform else [name]
    attribute(prim, "xformOpOrder", Types.TokenArray, order, uniform=True)


def _author_lens(prim: Sdf.PrimSpec, frames: Frames, meters_per_unit: float) -> None:
    lens = [
        lens_from_pinhole(pinhole, resolution, meters_per_unit)
        for pinhole, resolution in zip(frames.intrinsics, frames.resolution, strict=True)
    ]
    names = (
        "focalLength",
        "horizontalAperture",
        "verticalAperture",
        "horizontalApertureOffset",
        "verticalApertureOffset",
    )
    for name, values in zip(names, zip(*lens, strict=True), strict=True):
        attribute_per_frame(prim, name, Types.Float, values)
    attribute(prim, "projection", Types.Token, "perspective")
    near, far = NEAR_M / meters_per_unit, FAR_M / meters_per_unit
    attribute(prim, "clippingRange", Types.Float2, Gf.Vec2f(near, far))


def _author_exposure(prim: Sdf.PrimSpec, exposure_time: Double) -> None:
    """Exposure attributes whose product is 1: the frames are radiance already.

    USD: scale = responsivity * time * (iso / 100) * 2^exposure / fStop^2.
    """
    times = [t if math.isfinite(t) and t > 0 else 1.0 for t in map(float, exposure_time)]
    attribute(prim, "exposure", Types.Float, 0.0)
    attribute(prim, "exposure:fStop", Types.Float, 1.0)
    attribute(prim, "exposure:iso", Types.Float, 100.0)
    attribute_per_frame(prim, "exposure:time", Types.Float, times)
    attribute_per_frame(prim, "exposure:responsivity", Types.Float, [1.0 / time for time in times])


def _author_capture(prim: Sdf.PrimSpec, frames: Frames, folder: Path) -> None:
    photographs = Photographs(
        image=[storable_path(path, folder) for path in frames.image_paths],
        exposure_time=frames.exposure_time.tolist(),
        saturation_radiance=frames.saturation_radiance.tolist(),
        noise_floor_radiance=frames.noise_floor_radiance.tolist(),
        intrinsics=frames.intrinsics.tolist(),
        resolution=frames.resolution.tolist(),
        encoding=frames.encoding,
        radiometric=frames.radiometric,
    )
    for fact, value in known_facts(photographs):
        author_fact(prim, fact, value)
        if fact.name == "image":
            _author_back_plate(prim, value)


def _author_back_plate(prim: Sdf.PrimSpec, images: Sequence[str]) -> None:
    """The photographs where applications look for plates (new in USD 26.11; older versions pass
    over a schema that they do not know). Muted: no render may change because of them."""
    apply_schema(prim, f"BackPlateAPI:{_PLATE}")
    prefix, values = f"backPlate:{_PLATE}", [Sdf.AssetPath(image) for image in images]
    attribute_per_frame(prim, f"{prefix}:image", Types.Asset, values, always=True)
    attribute(prim, f"{prefix}:plateVisibility", Types.Token, "mute")
