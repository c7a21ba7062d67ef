"""What was said about an object -> the records that the tasks wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar, cast

from pxr import Gf, Sdf, Usd, UsdGeom

from usdbrdf.asset.properties import (
    AOV,
    FIT,
    SHADING,
    TEXTURING,
    Aov,
    FittedObject,
    Schema,
    ShadedObject,
    TexturedObject,
    facts_of,
)
from usdbrdf.asset.readers.frames import asset_file
from usdbrdf.asset.readers.scene import read_corner_uv, triangulation_of

_TIME = Usd.TimeCode.Default()
Record = TypeVar("Record")


def authored(prim: Usd.Prim, name: str) -> Any:
    """The authored value of an attribute: a schema's fallback is no measurement. Else None."""
    attribute = prim.GetAttribute(name)
    return attribute.Get(_TIME) if attribute and attribute.HasAuthoredValue() else None


def aov_path(stage: Usd.Stage, prim_path: str, aov: str) -> Path | None:
    """Absolute path of an object's map; None where the object has no such map."""
    attribute = stage.GetPrimAtPath(prim_path).GetAttribute(AOV.attribute("file", aov))
    return asset_file(attribute, _TIME) if attribute else None


def read_aovs(stage: Usd.Stage, prim_path: str) -> tuple[Aov, ...]:
    """All maps of an object, by name; from whatever layers the stage is composed of."""
    prim = stage.GetPrimAtPath(prim_path)
    paths = (p.GetName() for p in prim.GetAuthoredPropertiesInNamespace("usdBrdf:aov"))
    names = sorted(path.split(":")[2] for path in paths if path.endswith(":file"))
    return tuple(read_record(Aov, prim, name, name=name) for name in names)


def read_texturing(stage: Usd.Stage, prim_path: str) -> TexturedObject | None:
    """None before the task texture; ``aovs`` hold the maps of all tasks so far."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(prim_path))
    if not is_measured(mesh.GetPrim(), TEXTURING):
        return None
    corner_uv = read_corner_uv(mesh, triangulation_of(mesh))
    if corner_uv is None:
        return None
    aovs = read_aovs(stage, prim_path)
    return _read_object(TexturedObject, mesh.GetPrim(), corner_uv=corner_uv, aovs=aovs)


def read_shading(stage: Usd.Stage, prim_path: str) -> ShadedObject | None:
    """None before the task shade; ``aovs`` hold the maps of all tasks so far."""
    prim = stage.GetPrimAtPath(prim_path)
    if not is_measured(prim, SHADING):
        return None
    return _read_object(ShadedObject, prim, aovs=read_aovs(stage, prim_path))


def read_fit(stage: Usd.Stage, prim_path: str) -> FittedObject | None:
    """None before the task fit."""
    prim = stage.GetPrimAtPath(prim_path)
    return _read_object(FittedObject, prim) if is_measured(prim, FIT) else None


def is_measured(prim: Usd.Prim, schema: Schema) -> bool:
    """Whether anybody measured of a prim what the schema is about."""
    return authored(prim, schema.attribute(schema.key)) is not None


def read_record(kind: type[Record], prim: Usd.Prim, instance: str = "", **others: Any) -> Record:
    """A record as ``author_record`` said it; ``others`` are its fields that are no facts."""
    fields, row_type = dict(others), cast(type, kind)
    rows = facts_of(row_type)
    for field, fact in rows:
        value = authored(prim, fact.attribute(instance))
        if value is not None and field not in fields:
            fields[field] = fact.read(_plain(value))
        if fact.schema.flag:
            fields[fact.schema.flag] = is_measured(prim, fact.schema)
    unknown = {field: fact.unknown for field, fact in reversed(rows)}
    return kind(**unknown | fields)


def _read_object(kind: type[Record], prim: Usd.Prim, **others: Any) -> Record:
    identifier = str(authored(prim, "usdBrdf:identifier"))
    return read_record(kind, prim, prim_path=str(prim.GetPath()), identifier=identifier, **others)


def _plain(value: Any) -> Any:
    """A value of USD without its types: paths and words as text, vectors as tuples."""
    if isinstance(value, Sdf.AssetPath):
        return value.path
    return tuple(value) if isinstance(value, (Gf.Vec2i, Gf.Vec3f, Gf.Vec4d)) else value
