"""What every layer begins with: units, time, default prim, where its content came from; and where
our prims live below the default prim, without ever meeting an input file's own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, UsdGeom, Vt

from usdbrdf.asset.layout import Asset, open_metadata, record_of
from usdbrdf.asset.properties import SCHEMA_VERSION
from usdbrdf.asset.schemas import verify
from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.model.capture import Scan

TIME_CODES_PER_SECOND = 24.0
LAYOUT = "2"  # of the asset's folder; its layers outlive the version of the tool


@dataclass(frozen=True, kw_only=True)
class StageHeader:
    """Metadata that all layers share; USD reads it from the root and does not compare."""

    name: str  # of the default prim
    meters_per_unit: float = 1.0
    up_axis: str = "Z"  # or "Y"
    start: float = 1.0  # time codes of the first and the last photograph
    end: float = 1.0

    @staticmethod
    def of_scan(name: str, *scans: Scan) -> StageHeader:
        """Of a scan, or of several whose frames follow each other."""
        return StageHeader(
            name=name,
            meters_per_unit=scans[0].meters_per_unit,
            up_axis=scans[0].up_axis,
            end=float(max(1, sum(len(scan.frames) for scan in scans))),
        )


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """How a layer came about: the role, the code's version, its options, SHA-256 of its inputs.
    Nothing here may depend on the machine or the hour: equal work must give equal bytes."""

    role: str
    version: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


def new_layer(header: StageHeader, provenance: Provenance, **facts: Any) -> Sdf.Layer:
    """An anonymous layer with header and provenance; ``facts`` join the latter."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.defaultPrim = header.name
    layer.startTimeCode, layer.endTimeCode = header.start, header.end
    layer.timeCodesPerSecond = TIME_CODES_PER_SECOND
    layer.pseudoRoot.SetInfo(UsdGeom.Tokens.upAxis, header.up_axis)
    layer.pseudoRoot.SetInfo(UsdGeom.Tokens.metersPerUnit, header.meters_per_unit)
    record = {"schemaVersion": SCHEMA_VERSION, **vars(provenance), **facts}
    layer.customLayerData = {"usdbrdf": _stored(record)}
    return layer


def read_header(layer: Path) -> StageHeader:
    """The header of a layer file, without its content."""
    opened = open_metadata(layer)
    root = opened.pseudoRoot
    return StageHeader(
        name=str(opened.defaultPrim),
        meters_per_unit=float(root.GetInfo(UsdGeom.Tokens.metersPerUnit)),
        up_axis=str(root.GetInfo(UsdGeom.Tokens.upAxis)),
        start=float(opened.startTimeCode),
        end=float(opened.endTimeCode),
    )


def read_provenance(layer: Path) -> dict[str, Any]:
    """``customLayerData.usdbrdf`` of a layer file; empty where it has none, or there is none."""
    if not layer.is_file():
        return {}
    return record_of(open_metadata(layer))


def capture_up_of(asset: Asset) -> str:
    """The axis that was up in an asset's capture, where it was turned (``model.upright``); ""
    where it was not."""
    return str(read_provenance(asset.layer("scan")).get("capture_up", ""))


def refuse_old_layout(asset: Asset) -> None:
    """OwnershipConflict where a version made the asset that had other files and other prims. The
    root layer is kept, and edits.usda is about the prims that were there."""
    if read_provenance(asset.root_layer).get("version") == "1":
        raise OwnershipConflict(
            f"{asset.root_layer}: the asset was made by an earlier usdbrdf, whose objects were no "
            "components. Convert the capture into a new folder, and take your edits.usda over with "
            "the mesh </NAME/geo/chair> as </NAME/geo/chair/chair> and the material "
            "</NAME/mtl/chair> as </NAME/geo/chair/mtl/chair>. [ownership.layout]"
        )


def refuse_newer(*layers: Path) -> None:
    """InputRefused where one of the tool's layers states schemas that this version does not know:
    what it calls by the same name may be something else, and would be taken for what we know."""
    for layer in layers:
        known = read_provenance(layer).get("schemaVersion", 1)
        if isinstance(known, int) and known > SCHEMA_VERSION:
            raise InputRefused(
                f"{layer}: written by a newer usdbrdf (schema version {known}, this one knows "
                f"{SCHEMA_VERSION}). Install that version, or convert the capture into a new "
                "folder. [asset.newer]"
            )


def _stored(value: Any) -> Any:
    """A value as USD's dictionaries hold it: without None, and no mixed lists."""
    if isinstance(value, Mapping):
        return {str(key): _stored(held) for key, held in value.items() if held is not None}
    if isinstance(value, (np.ndarray, np.generic)):
        return _stored(value.tolist())
    if not isinstance(value, Sequence) or isinstance(value, str):
        return value if isinstance(value, (bool, int, float, str)) else str(value)
    kinds = {type(held) for held in value}
    if kinds == {bool}:
        return Vt.BoolArray(list(value))
    if kinds == {int} and all(abs(held) < 2**31 for held in value):
        return Vt.IntArray(list(value))
    if kinds and kinds <= {int, float}:
        return Vt.DoubleArray([float(held) for held in value])
    return Vt.StringArray([str(held) for held in value])


_SCOPES = {"geometry": "geo", **{name: name for name in ("cameras", "lights", "render")}}
# What lies beside the mesh of an object.
_MATERIALS, _LOOKS = "mtl", "looks"


@dataclass(frozen=True)
class Scopes:
    """Names of the scopes that hold our prims; ``root`` is the default prim's path. If the geometry
    came as USD, its default prim may have children of these names already (``geo`` is the usual
    one): ours then begin with ``usdbrdf_``, since prims of one path would merge."""

    root: str
    names: Mapping[str, str]

    @staticmethod
    def beside(root: str, taken: Collection[str]) -> Scopes:
        """Scopes whose names are not among ``taken``, the children of an input's default prim."""
        names = dict(_SCOPES)
        for scope in names:
            while names[scope] in taken:
                names[scope] = f"usdbrdf_{names[scope]}"
        return Scopes(root, names)

    @staticmethod
    def of(asset: Asset) -> Scopes:
        """The scopes that the asset's scan layer recorded; the usual ones before it exists."""
        recorded = read_provenance(asset.layer("scan")).get("scopes", {})
        # Versions that knew no lights did not look whether the input has some of that name.
        lights = {"lights": "usdbrdf_lights"} if recorded else {}
        return Scopes(f"/{asset.name}", {**_SCOPES, **lights, **recorded})

    def path(self, scope: str, *names: str) -> str:
        """Path of a prim in a scope: ``path("cameras", "capture")`` is /NAME/cameras/capture."""
        return "/".join((self.root, self.names[scope], *names))

    def component(self, identifier: str) -> str:
        """The prim that has all that belongs to an object, so that it can be referenced alone; but
        for the mesh of an input file, which stays where the file has it."""
        return self.path("geometry", identifier)

    def mesh(self, identifier: str) -> str:
        """The object's mesh, named as the object: applications list meshes by their names."""
        taken = identifier in (_MATERIALS, _LOOKS)
        return self.path("geometry", identifier, f"{identifier}_mesh" if taken else identifier)

    def material(self, identifier: str, *nodes: str) -> str:
        """The measured material of an object, or a node of it."""
        return self.path("geometry", identifier, _MATERIALS, identifier, *nodes)

    def look(self, identifier: str, name: str) -> str:
        """What an object wears in a look that shows a map."""
        return self.path("geometry", identifier, _LOOKS, name)


@dataclass(frozen=True, kw_only=True)
class Draft:
    """A layer about to be written: the asset that it belongs to, and what it begins with."""

    asset: Asset
    header: StageHeader
    provenance: Provenance

    @cached_property
    def scopes(self) -> Scopes:
        return Scopes.of(self.asset)

    def new_layer(self, **facts: Any) -> Sdf.Layer:
        """An anonymous layer with header, provenance and the default prim as an ``over``;
        ``facts`` join the provenance. Raises where USD does not know our schemas."""
        verify()
        layer = new_layer(self.header, self.provenance, **facts)
        Sdf.CreatePrimInLayer(layer, f"/{self.header.name}")
        return layer
