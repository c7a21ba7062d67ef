"""What every layer begins with: units, time, default prim, where its content came from; and where
our prims live below the default prim, without ever meeting an input file's own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, UsdGeom, Vt

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.properties import SCHEMA_VERSION
from usdbrdf.asset.schema import verify
from usdbrdf.errors import InputRefused
from usdbrdf.model.capture import Scan

TIME_CODES_PER_SECOND = 24.0


@dataclass(frozen=True, kw_only=True)
class StageHeader:
    """Metadata that all layers share; USD reads it from the root and does not compare.

    name             default prim
    meters_per_unit  length of a scene unit in metres
    up_axis          "Y" or "Z"
    start, end       time codes of the first and the last photograph
    """

    name: str
    meters_per_unit: float = 1.0
    up_axis: str = "Z"
    start: float = 1.0
    end: float = 1.0

    @staticmethod
    def of_scan(name: str, scan: Scan) -> StageHeader:
        return StageHeader(
            name=name,
            meters_per_unit=scan.meters_per_unit,
            up_axis=scan.up_axis,
            end=float(max(1, len(scan.frames))),
        )


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """How a layer came about: the role, the code's version, its options, SHA-256 of its inputs.

    Nothing here may depend on the machine or the hour: equal work must give equal bytes.
    """

    role: str
    version: str
    parameters: Mapping[str, Any] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)


def new_layer(header: StageHeader, provenance: Provenance, **facts: Any) -> Sdf.Layer:
    """An anonymous layer with header and provenance; ``facts`` join the latter."""
    layer = Sdf.Layer.CreateAnonymous(".usda")
    layer.defaultPrim = header.name
    layer.startTimeCode = header.start
    layer.endTimeCode = header.end
    layer.timeCodesPerSecond = TIME_CODES_PER_SECOND
    layer.pseudoRoot.SetInfo(UsdGeom.Tokens.upAxis, header.up_axis)
    layer.pseudoRoot.SetInfo(UsdGeom.Tokens.metersPerUnit, header.meters_per_unit)
    record = {
        "role": provenance.role,
        "schemaVersion": SCHEMA_VERSION,
        "version": provenance.version,
        "parameters": provenance.parameters,
        "inputs": provenance.inputs,
        **facts,
    }
    layer.customLayerData = {"usdbrdf": _dictionary(record)}
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
    """``customLayerData.usdbrdf`` of a layer file; empty where it has none."""
    return dict(open_metadata(layer).customLayerData.get("usdbrdf", {}))


def open_metadata(layer: Path) -> Sdf.Layer:
    """A private copy of a layer's metadata, read from the file as it is now."""
    refused = InputRefused(
        f"{layer}: this is not a readable USD layer. Run `usdbrdf convert` again, which makes it "
        "anew. [stage.unreadable]"
    )
    try:
        opened = Sdf.Layer.OpenAsAnonymous(str(layer), metadataOnly=True)
    except Tf.ErrorException as error:
        raise refused from error
    if not opened:
        raise refused
    return opened


def _dictionary(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values as USD stores them in a dictionary; None, which it has not, is left out."""
    return {str(key): _stored(value) for key, value in values.items() if value is not None}


def _stored(value: Any) -> Any:
    if isinstance(value, Mapping):
        return _dictionary(value)
    if isinstance(value, np.ndarray):
        return _stored(value.tolist())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return _array(list(value))
    return value if isinstance(value, (bool, int, float, str)) else str(value)


def _array(values: list[Any]) -> Any:
    """A typed array: USD's dictionaries hold no mixed lists."""
    kinds = {type(value) for value in values}
    if kinds and kinds <= {bool}:
        return Vt.BoolArray(values)
    if kinds and kinds <= {int} and all(abs(value) < 2**31 for value in values):
        return Vt.IntArray(values)
    if kinds and kinds <= {int, float}:
        return Vt.DoubleArray([float(value) for value in values])
    return Vt.StringArray([str(value) for value in values])


@dataclass(frozen=True, kw_only=True)
class Scopes:
    """Names of the scopes that hold our prims; ``root`` is the default prim's path.

    If the geometry came as USD, its default prim may have children of these names already (``mtl``
    is the usual one): ours then begin with ``usdbrdf_``, since prims of one path would merge.
    """

    root: str
    geometry: str = "geo"
    materials: str = "mtl"
    looks: str = "looks"
    cameras: str = "cameras"
    lights: str = "lights"
    render: str = "render"

    @staticmethod
    def beside(root: str, taken: Collection[str]) -> Scopes:
        """Scopes whose names are not among ``taken``, the children of an input's default prim."""
        names = {f.name: str(f.default) for f in fields(Scopes) if f.name != "root"}
        for field_name, name in names.items():
            while name in taken:
                name = f"usdbrdf_{name}"
            names[field_name] = name
        return Scopes(root=root, **names)

    @staticmethod
    def of(asset: Asset) -> Scopes:
        """The scopes that the asset's scan layer recorded; the usual ones before it exists."""
        root = f"/{asset.name}"
        layer = asset.layer("scan")
        recorded = read_provenance(layer).get("scopes", {}) if layer.is_file() else {}
        # Versions that knew no lights did not look whether the input has some of that name.
        names = {"lights": "usdbrdf_lights", **recorded} if recorded else {}
        return Scopes(root=root, **{name: str(value) for name, value in names.items()})

    def names(self) -> dict[str, str]:
        """What the scan layer records."""
        return {name: value for name, value in asdict(self).items() if name != "root"}

    def path(self, scope: str, *names: str) -> str:
        """Path of a prim in a scope: ``path("materials", "chair")`` is /NAME/mtl/chair."""
        return "/".join((self.root, getattr(self, scope), *names))


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
