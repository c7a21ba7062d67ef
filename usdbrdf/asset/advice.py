"""What to photograph next, in a layer of its own: ``layers/advice.usda``, guide cameras with the
reason for each.

No layer names it, as with the photographs: whoever wants to see the cameras adds it to the
sublayers of edits.usda. ``usdbrdf advise`` alone writes it, whole."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, UsdGeom

from usdbrdf.asset.header import Draft, Provenance, read_header, read_provenance
from usdbrdf.asset.layers.author import attribute, define, export
from usdbrdf.asset.layers.scan_layer import FAR_M, NEAR_M, lens_from_pinhole
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.scene import LENS
from usdbrdf.asset.readers.tried import try_layers
from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import environment_failures, publish, sha256_of, temporary_beside
from usdbrdf.job.versions import refuse_version
from usdbrdf.model.camera import Camera

Types = Sdf.ValueTypeNames
_VERSION = "1"  # of what is written, not of the program


@dataclass(frozen=True, kw_only=True)
class AdvisedObject:
    """What a photograph is expected to tell of an object: the standard deviations of phi and psi
    before it and after it; how likely both are measured then; what it shows reflected, an
    identifier, "" for what lies beyond the scan."""

    prim_path: str
    identifier: str
    phi_error: float
    psi_error: float
    phi_error_expected: float
    psi_error_expected: float
    measured_expected: float
    reflects: str


@dataclass(frozen=True, kw_only=True)
class AdvisedPose:
    """One photograph to take.

    camera         in metres, in the world
    exposure_time  s; where nobody said how long the frames were exposed, relative to theirs
    exposure       the same in words
    height         m above the ground, NaN where there is none
    looks_at       identifier of what is in the middle of the picture, "" for nothing
    where, reason  for the person who takes it
    objects        what it tells most of
    new_area, unclipped_area   m^2 seen for the first time, and for the first time without clipping
    """

    camera: Camera
    exposure_time: float
    exposure: str
    height: float
    looks_at: str
    where: str
    reason: str
    objects: tuple[AdvisedObject, ...]
    new_area: float
    unclipped_area: float

    @property
    def summary(self) -> dict[str, Any]:
        """JSON."""
        ahead = -self.camera.world_from_camera[:3, 2]
        return {
            "eye": [round(float(value), 4) for value in self.camera.eye],
            "direction": [round(float(value), 4) for value in ahead],
            "height": round(self.height, 3) if math.isfinite(self.height) else None,
            "looks_at": self.looks_at,
            "exposure_time": self.exposure_time,
            "exposure": self.exposure,
            "where": self.where,
            "reason": self.reason,
            "new_area": round(self.new_area, 4),
            "unclipped_area": round(self.unclipped_area, 4),
            "objects": [_rounded(asdict(one)) for one in self.objects],
        }


def _rounded(record: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: round(value, 4) if isinstance(value, float) else value
        for name, value in record.items()
    }


def inputs_of_advice(asset: Asset) -> dict[str, str]:
    """SHA-256 of what advice follows from: the layers that the steps wrote."""
    layers = (asset.layer(role) for role in ROLES)
    return {layer.name: sha256_of(layer) for layer in layers if layer.is_file()}


def write_advice(asset: Asset, poses: Sequence[AdvisedPose], parameters: Mapping[str, Any]) -> Path:
    """Write the layer, whole or not at all. Where nothing is advised it has no cameras, and stays
    for those who made it a sublayer. Equal advice gives equal bytes."""
    refuse_version(asset.folder)
    file, header = asset.advice_layer, read_header(asset.layer("scan"))
    draft = Draft(
        asset=asset,
        header=header,
        provenance=Provenance(
            role="advice", version=_VERSION, parameters=parameters, inputs=inputs_of_advice(asset)
        ),
    )
    layer = draft.new_layer()
    layer.documentation = (
        "What to photograph next, by usdbrdf advise, which writes it anew. To see the cameras add "
        "it to the sublayers of edits.usda."
    )
    for number, pose in enumerate(poses, start=1):
        _author_pose(layer, draft.scopes.path("cameras", f"advised_{number}"), pose, draft)
    with environment_failures(str(file)), temporary_beside(file) as staged:
        export(layer, staged, folder=file.parent)
        publish(staged, file)
    return file


def _author_pose(layer: Sdf.Layer, path: str, pose: AdvisedPose, draft: Draft) -> None:
    unit, camera = draft.header.meters_per_unit, pose.camera
    prim = define(layer, path, "Camera")
    prim.documentation = f"{pose.where} {pose.reason}"
    prim.customData = {"usdbrdf": {"advice": _stored(pose.summary)}}
    attribute(prim, "purpose", Types.Token, UsdGeom.Tokens.guide, uniform=True)
    matrix = np.array(camera.world_from_camera, np.float64)
    matrix[:3, 3] /= unit
    # USD multiplies row vectors from the left: its matrices are ours transposed. The pose is in the
    # world, wherever what is above it lies.
    attribute(prim, "xformOp:transform", Types.Matrix4d, Gf.Matrix4d(matrix.T.tolist()))
    order = ["!resetXformStack!", "xformOp:transform"]
    attribute(prim, "xformOpOrder", Types.TokenArray, order, uniform=True)
    size = (camera.width, camera.height)
    lens = lens_from_pinhole(np.array(camera.intrinsics), size, unit)
    for name, value in zip(LENS, lens, strict=True):
        attribute(prim, name, Types.Float, value)
    attribute(prim, "projection", Types.Token, UsdGeom.Tokens.perspective)
    attribute(prim, "clippingRange", Types.Float2, Gf.Vec2f(NEAR_M / unit, FAR_M / unit))


def _stored(summary: Mapping[str, Any]) -> dict[str, Any]:
    """A summary as USD's dictionaries hold it: lists of records become records by number."""
    rows = {f"object_{k}": row for k, row in enumerate(summary["objects"])}
    numbers = {name: Gf.Vec3d(*summary[name]) for name in ("eye", "direction")}
    plain = {k: v for k, v in summary.items() if v is not None and k != "objects"}
    return {**plain, **numbers, "objects": rows}


def read_advice(asset: Asset) -> tuple[list[dict[str, Any]], bool] | None:
    """The summaries of the advised poses, and whether they follow from the asset as it is now; None
    where there is no advice. InputRefused where the layer is no USD or holds something else."""
    file = asset.advice_layer
    if not file.is_file():
        return None
    layer = None
    with suppress(Tf.ErrorException, InputRefused):
        try_layers([file])
        layer = Sdf.Layer.OpenAsAnonymous(str(file))
    found: list[tuple[int, dict[str, Any]]] = []
    if layer is not None:

        def visit(path: Sdf.Path) -> None:
            spec = layer.GetObjectAtPath(path)
            if isinstance(spec, Sdf.PrimSpec) and spec.name.startswith("advised_"):
                record = spec.customData["usdbrdf"]["advice"]
                found.append((int(spec.name.removeprefix("advised_")), _plain(record)))

        with suppress(AttributeError, KeyError, TypeError, ValueError):
            layer.Traverse(Sdf.Path.absoluteRootPath, visit)
            recorded = read_provenance(file)
            if recorded.get("role") == "advice":
                follows = recorded.get("inputs", {}) == inputs_of_advice(asset)
                return [row for _, row in sorted(found)], follows
    raise InputRefused(
        f"{file}: this is not the advice that was written. Run `usdbrdf advise` again, or delete "
        "the file. [advice.layer]"
    )


def _plain(record: Mapping[str, Any]) -> dict[str, Any]:
    """The inverse of ``_stored``."""
    rows = record["objects"]
    found = {
        name: [float(number) for number in value] if isinstance(value, Gf.Vec3d) else value
        for name, value in record.items()
        if name != "objects"
    }
    objects = [dict(rows[key]) for key in sorted(rows, key=lambda key: int(key.split("_")[1]))]
    return {"height": None, **found, "objects": objects}
