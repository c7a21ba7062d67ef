"""A composed stage -> what capture and tasks said in it: photographs, the labelled meshes as one
triangle soup in metres, and the records of the objects."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from usdbrdf.asset.layout import LIGHTING, record_of
from usdbrdf.asset.properties import (
    AOV,
    CAPTURE,
    FIT,
    OBJECT,
    OUTSIDE,
    SHADING,
    TEXTURING,
    Aov,
    Fact,
    FittedObject,
    LightFromOutside,
    Photographs,
    Schema,
    ShadedObject,
    facts_of,
)
from usdbrdf.asset.readers.foreign import place_of, refuses_foreign
from usdbrdf.errors import InputRefused
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.model.arrays import Float, Int
from usdbrdf.model.capture import Frames, Recorded, recorded_together
from usdbrdf.model.mesh import INTERPOLATIONS, Triangulation, triangulate
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted.usd_files import numbers_of

Record = TypeVar("Record")
Number = TypeVar("Number", np.float32, np.float64)
_TIME = Usd.TimeCode.EarliestTime()  # the default value too, where nothing is animated
LENS = (
    "focalLength",
    "horizontalAperture",
    "verticalAperture",
    "horizontalApertureOffset",
    "verticalApertureOffset",
)
_IMAGE, _EXPOSURE = CAPTURE.attribute("image"), CAPTURE.attribute("exposureTime")
_PINHOLE = CAPTURE.attribute(CAPTURE.key)


@refuses_foreign("the lighting")
def lighting_of_stage(stage: Usd.Stage) -> str:
    """The lighting that is selected; "" where there is but one."""
    return str(stage.GetDefaultPrim().GetVariantSet(LIGHTING).GetVariantSelection())


@refuses_foreign("the photographs")
def frames_from_stage(stage: Usd.Stage) -> Frames:
    """The photographs, with poses in metres and absolute image paths, in the order of time."""
    camera = capture_camera(stage)
    exposure = camera.GetPrim().GetAttribute(_EXPOSURE)
    times = exposure.GetTimeSamples()
    # Row vectors in USD: transposed they are ours.
    poses = np.array([camera.ComputeLocalToWorldTransform(time) for time in times])
    poses = np.ascontiguousarray(poses.transpose(0, 2, 1))
    poses[:, :3, 3] *= UsdGeom.GetStageMetersPerUnit(stage)
    read: dict[str, Any] = {}
    held: dict[str, list[Any]] = {}
    for field, fact in facts_of(Photographs):
        attribute = camera.GetPrim().GetAttribute(fact.attribute())
        if fact.type in ("asset", "string"):
            continue
        if field in Recorded._fields:
            held[field] = [attribute.Get(time) for time in times]
            continue
        if fact.samples:
            read[field] = np.array([attribute.Get(time) for time in times], np.float64)
        else:
            value = attribute.Get()
            read[field] = tuple(value) if fact.type == "double2" else value
    read["resolution"] = read["resolution"].astype(np.int32)
    image = camera.GetPrim().GetAttribute(_IMAGE)
    # Without the layer that tells where they lie, they have numbers.
    unknown = Path(exposure.GetPropertyStack(times[0])[0].layer.realPath).with_name("photographs")
    found = (asset_file(image, time) if image else None for time in times)
    paths = [file or unknown / f"{i + 1:04d}" for i, file in enumerate(found)]

    def of_all(name: str, get: Callable[[Usd.Attribute, float], Any]) -> tuple[Any, ...]:
        """What only some captures say of their photographs; () where this one does not."""
        attribute = camera.GetPrim().GetAttribute(CAPTURE.attribute(name))
        said = attribute and attribute.HasAuthoredValue()
        return tuple(get(attribute, time) for time in times) if said else ()

    return Frames(
        **recorded_together(
            [
                Recorded(**dict(zip(held, image, strict=True)))
                for image in zip(*held.values(), strict=True)
            ]
        ),
        image_paths=tuple(paths),
        world_from_camera=poses,
        photographs=of_all("photograph", asset_file),
        masks=of_all("mask", asset_file),
        lenses=of_all("lens", lambda lens, time: str(lens.Get(time))),
        lightings=of_all("lighting", lambda lighting, time: str(lighting.Get(time))),
        **read,
    )


@refuses_foreign("the photographs")
def hashes_of_photographs(stage: Usd.Stage) -> list[str]:
    """The SHA-256 of each frame's photograph, and of its mask behind a space, as ingest read them,
    in the order of time; "" where nothing tells."""
    camera = capture_camera(stage).GetPrim()
    times = camera.GetAttribute(_EXPOSURE).GetTimeSamples()
    said = camera.GetAttribute(CAPTURE.attribute("sha256"))
    return [str((said and said.Get(time)) or "") for time in times]


def capture_camera(stage: Usd.Stage) -> UsdGeom.Camera:
    """The camera that carries the photographs."""
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Camera) and authored(prim, _PINHOLE) is not None:
            return UsdGeom.Camera(prim)
    raise InputRefused(
        f"{place_of(stage)}: no camera of the stage has taken photographs "
        "(usdBrdf:capture:pinhole). Run ingest again. [stage.camera]"
    )


def asset_file(attribute: Usd.Attribute, time: Usd.TimeCode | float) -> Path | None:
    """Absolute path of the file that an attribute names, existing or not; None if empty."""
    value = attribute.Get(time)
    if not value or not value.path:
        return None
    # Relative to the layer that holds the opinion.
    layer = attribute.GetPropertyStack(time)[0].layer
    return Path(value.resolvedPath or layer.ComputeAbsolutePath(value.path))


def _records_of_scan(stage: Usd.Stage) -> list[dict[str, Any]]:
    """What the scan layers of a stage say of how they were made."""
    used = map(record_of, stage.GetUsedLayers())
    return [record for record in used if record.get("role") == "scan"]


def capture_up_of_stage(stage: Usd.Stage) -> str:
    """As ``header.capture_up_of`` the asset that a stage shows."""
    return next((str(r["capture_up"]) for r in _records_of_scan(stage) if "capture_up" in r), "")


@refuses_foreign("the meshes")
def scene_from_stage(stage: Usd.Stage) -> Scene:
    """All objects, in the order of traversal: meshes with usdBrdf:label, in the world, in metres.
    Meshes without normals of their own get them by the crease angle that ingest was given."""
    prims = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh) and is_measured(p, OBJECT)]
    if not prims:
        raise InputRefused(
            f"{place_of(stage)}: no mesh of the stage has a usdBrdf:label. "
            "Run `usdbrdf ingest` again. [stage.objects]"
        )
    given = (record.get("parameters", {}) for record in _records_of_scan(stage))
    angles = (parameters.get("crease_angle_deg") for parameters in given)
    angle = next((a for a in angles if a is not None), IngestOptions().crease_angle_deg)
    read = (_read_mesh(UsdGeom.Mesh(prim), float(angle)) for prim in prims)
    points, triangles, normals, uvs = zip(*read, strict=True)
    num_faces = [len(own) for own in triangles]
    first_face, first_point = np.cumsum([0, *num_faces]), np.cumsum([0, *map(len, points)])
    objects = tuple(
        SceneObject(
            prim_path=str(prim.GetPath()),
            identifier=str(prim.GetAttribute("usdBrdf:identifier").Get() or prim.GetName()),
            label=str(prim.GetAttribute("usdBrdf:label").Get()),
            class_name=str(prim.GetAttribute("usdBrdf:class").Get() or ""),
            first_face=int(first_face[i]),
            num_faces=num_faces[i],
        )
        for i, prim in enumerate(prims)
    )
    without = [prim.GetPath() for prim, uv in zip(prims, uvs, strict=True) if uv is None]
    if 0 < len(without) < len(prims):
        raise InputRefused(
            f"<{without[0]}>: the mesh has no texture coordinates though others have. "
            "Run `usdbrdf texture` again. [stage.st]"
        )
    shifted = [own + first_point[i] for i, own in enumerate(triangles)]
    return Scene(
        objects=objects,
        points=np.concatenate(points),
        triangles=np.concatenate(shifted).astype(np.int32),
        corner_normals=np.concatenate(normals),
        face_object=np.repeat(np.arange(len(prims), dtype=np.int32), num_faces),
        corner_uv=None if without else np.concatenate(uvs),
    )


def _read_mesh(
    mesh: UsdGeom.Mesh, crease_angle_deg: float
) -> tuple[Float, Int, Float, Float | None]:
    """Points in the world, triangles, their corners' normals and texture coordinates of ours."""
    fans = triangulation_of(mesh)
    world_from_local = np.array(mesh.ComputeLocalToWorldTransform(_TIME)).T
    meters = UsdGeom.GetStageMetersPerUnit(mesh.GetPrim().GetStage())
    local = np.asarray(mesh.GetPointsAttr().Get(_TIME), np.float64).reshape(-1, 3)
    world = (local @ world_from_local[:3, :3].T + world_from_local[:3, 3]) * meters
    points = np.ascontiguousarray(world, np.float32)
    triangles, normals, uv = fans.triangles, authored_normals(mesh, fans), None
    # An input file's own primvars:st does not count: only ours go with our textures.
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    if is_measured(mesh.GetPrim(), TEXTURING) and primvar:
        uv = np.asarray(primvar.ComputeFlattened(_TIME), np.float32)[fans.corners]
    if _is_mirrored(mesh):
        triangles = np.ascontiguousarray(triangles[:, [0, 2, 1]])
        uv = None if uv is None else uv[:, [0, 2, 1]]
        normals = None if normals is None else normals[:, [0, 2, 1]]
    if normals is None:
        in_world = corner_normals(points, triangles, crease_angle_deg)
    else:
        turned = normals @ np.linalg.inv(world_from_local[:3, :3])
        unit = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        in_world = np.ascontiguousarray(unit, np.float32)
    return points, triangles, in_world, uv


@refuses_foreign("the meshes")
def given_corner_uv(stage: Usd.Stage, prim_path: str) -> Float | None:
    """(T, 3, 2) texture coordinates that an input file's mesh came with, for the corners of the
    object's triangles as ``scene_from_stage`` orders them; None where it has none to use."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(prim_path))
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    given = primvar.ComputeFlattened(_TIME) if primvar and primvar.HasAuthoredValue() else None
    if not isinstance(given, Vt.Vec2fArray | Vt.Vec2dArray | Vt.Vec2hArray):
        return None
    uv = per_corner(given, np.float32, primvar.GetInterpolation(), triangulation_of(mesh))
    return uv[:, [0, 2, 1]] if uv is not None and _is_mirrored(mesh) else uv


def per_corner(
    values: Any, kind: type[Number], interpolation: str, fans: Triangulation
) -> npt.NDArray[Number] | None:
    """(T, 3, ...) the value that each triangle's corner has; None where there are too few of them,
    or USD knows no such interpolation: the file is wrong about these values, not about its shape.
    """
    if interpolation not in INTERPOLATIONS:
        return None
    elements = fans.element_of_corner(interpolation)
    return np.asarray(values, kind)[elements] if elements.max(initial=-1) < len(values) else None


def triangulation_of(mesh: UsdGeom.Mesh) -> Triangulation:
    """The mesh as triangles, counter-clockwise seen from outside, in its own frame."""
    points = numbers_of(mesh.GetPointsAttr().Get(_TIME), np.float64, 3)
    indices = numbers_of(mesh.GetFaceVertexIndicesAttr().Get(_TIME), np.int32)
    there = indices.size and indices.min() >= 0 and indices.max() < len(points)
    return triangulate(
        numbers_of(mesh.GetFaceVertexCountsAttr().Get(_TIME), np.int32),
        indices,
        left_handed=mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded,
        holes=numbers_of(mesh.GetHoleIndicesAttr().Get(_TIME), np.int32),
        points=points if there else None,
    )


def _is_mirrored(mesh: UsdGeom.Mesh) -> bool:
    return bool(np.linalg.det(np.array(mesh.ComputeLocalToWorldTransform(_TIME))[:3, :3]) < 0)


def authored_normals(
    mesh: UsdGeom.Mesh, fans: Triangulation, time: Usd.TimeCode = _TIME
) -> npt.NDArray[np.float64] | None:
    """(T, 3, 3) authored normals in the mesh's frame; None where there are none to use."""
    primvar = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("normals")  # stronger than the attribute
    if primvar and primvar.HasAuthoredValue():
        values, interpolation = primvar.ComputeFlattened(time), primvar.GetInterpolation()
    else:
        values = mesh.GetNormalsAttr().Get(time)
        interpolation = mesh.GetNormalsInterpolation()
    chosen = per_corner(values, np.float64, interpolation, fans) if values else None
    if chosen is None or not np.isfinite(chosen).all():
        return None
    return chosen if (np.linalg.norm(chosen, axis=-1) > 1e-12).all() else None


def authored(prim: Usd.Prim, name: str) -> Any:
    """The authored value of an attribute: a schema's fallback is no measurement. Else None."""
    attribute = prim.GetAttribute(name)
    return attribute.Get() if attribute and attribute.HasAuthoredValue() else None


def stored(prim: Usd.Prim, fact: Fact, instance: str = "") -> Any:
    """As ``authored``, of an asset of an older version too."""
    value = authored(prim, fact.attribute(instance))
    older = value is None and fact.formerly
    return authored(prim, f"{fact.schema.namespace}:{fact.formerly}") if older else value


def is_measured(prim: Usd.Prim, schema: Schema) -> bool:
    """Whether anybody measured of a prim what the schema is about."""
    return authored(prim, schema.attribute(schema.key)) is not None


@refuses_foreign("the maps")
def aov_path(stage: Usd.Stage, prim_path: str, aov: str) -> Path | None:
    """Absolute path of an object's map; None where the object has no such map."""
    attribute = stage.GetPrimAtPath(prim_path).GetAttribute(AOV.attribute("file", aov))
    return asset_file(attribute, Usd.TimeCode.Default()) if attribute else None


@refuses_foreign("the maps")
def read_aovs(stage: Usd.Stage, prim_path: str) -> tuple[Aov, ...]:
    """All maps of an object, by name; from whatever layers the stage is composed of."""
    prim = stage.GetPrimAtPath(prim_path)
    paths = (p.GetName() for p in prim.GetAuthoredPropertiesInNamespace("usdBrdf:aov"))
    names = sorted(path.split(":")[2] for path in paths if path.endswith(":file"))
    return tuple(read_record(Aov, prim, name, name=name) for name in names)


def read_object(
    kind: type[Record], schema: Schema, stage: Usd.Stage, prim_path: str, **others: Any
) -> Record | None:
    """What the task of a schema said of an object, its maps apart; None before that task."""
    prim = stage.GetPrimAtPath(prim_path)
    if not is_measured(prim, schema):
        return None
    identifier = str(authored(prim, "usdBrdf:identifier"))
    return read_record(kind, prim, prim_path=prim_path, identifier=identifier, **others)


@refuses_foreign("the light from outside")
def light_from_outside(stage: Usd.Stage) -> tuple[LightFromOutside, Path] | None:
    """What shading said of the light from outside, and the absolute path of its picture; None where
    it found none."""
    prim = stage.GetDefaultPrim()
    if not prim or not is_measured(prim, OUTSIDE):
        return None
    file = asset_file(prim.GetAttribute(OUTSIDE.attribute(OUTSIDE.key)), Usd.TimeCode.Default())
    return (read_record(LightFromOutside, prim), file) if file else None


@refuses_foreign("the textures")
def read_unwrapped(stage: Usd.Stage, prim_path: str) -> tuple[tuple[int, int], float]:
    """Width and height of an object's textures, and the side of a texel in metres; InputRefused
    where it was not unwrapped yet."""
    prim = stage.GetPrimAtPath(prim_path)
    size, side = (authored(prim, TEXTURING.attribute(n)) for n in ("resolution", TEXTURING.key))
    if size is None or side is None:
        raise InputRefused(
            f"<{prim_path}>: the mesh has no textures of ours. Run `usdbrdf texture` again. "
            "[stage.st]"
        )
    return (int(size[0]), int(size[1])), float(side)


read_shading = partial(read_object, ShadedObject, SHADING)
read_fit = partial(read_object, FittedObject, FIT)


@refuses_foreign("the objects")
def read_record(kind: type[Record], prim: Usd.Prim, instance: str = "", **others: Any) -> Record:
    """A record as ``author_record`` said it; ``others`` are its fields that are no facts."""
    fields, row_type = dict(others), cast(type, kind)
    rows = facts_of(row_type)
    for field, fact in rows:
        value = stored(prim, fact, instance)
        if value is not None and field not in fields:
            if isinstance(value, Sdf.AssetPath):
                value = value.path
            elif isinstance(value, (Gf.Vec2i, Gf.Vec3f, Gf.Vec4d)):
                value = tuple(value)
            fields[field] = fact.read(value)
        if fact.schema.flag:
            fields[fact.schema.flag] = is_measured(prim, fact.schema)
    unknown = {field: fact.unknown for field, fact in reversed(rows)}
    return kind(**unknown | fields)
