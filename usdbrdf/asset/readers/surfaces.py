"""The composed stage as a renderer sees it: every visible mesh in the world, with its material."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from pxr import Usd, UsdGeom, UsdShade

from usdbrdf.asset.readers.materials import BoundMaterial, fit_mappings, material_from_usd
from usdbrdf.asset.readers.scene import authored_normals, triangulation_of
from usdbrdf.errors import InputRefused
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.material import Surface
from usdbrdf.model.mesh import Triangulation

# Meshes that bring no normals are smooth where their faces meet at less than this.
_CREASE_ANGLE_DEG = 40.0
# Prims that a sentence names.
_MAX_SHOWN = 5
_PURPOSES = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)


class _Reading(NamedTuple):
    """When the stage is looked at, how its fits were mapped to materials, and who is told what is
    left out."""

    time: Usd.TimeCode
    mappings: Mapping[str, str]
    warn: Callable[[str], None]


def surfaces_from_stage(
    stage: Usd.Stage, time: Usd.TimeCode, warn: Callable[[str], None], subject: Path | None = None
) -> tuple[Surface, ...]:
    """All active, visible meshes, in metres in the stage's world, split where subsets of their
    faces are bound to other materials. Subdivision cages are taken as the surface.

    warn     is told, in sentences, what was left out
    subject  what these sentences are about; None: the stage's root layer
    """
    surfaces: list[Surface] = []
    transforms = UsdGeom.XformCache(time)
    left_out: list[Usd.Prim] = []
    reading = _Reading(time, fit_mappings(stage), warn)
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Gprim) and not prim.IsA(UsdGeom.PointInstancer):
            continue
        imageable = UsdGeom.Imageable(prim)
        if imageable.ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            continue
        if imageable.ComputePurpose() not in _PURPOSES:
            continue
        if not prim.IsA(UsdGeom.Mesh):
            left_out.append(prim)
            continue
        world_from_local = np.array(transforms.GetLocalToWorldTransform(prim)).T
        surfaces += _surfaces_of_mesh(UsdGeom.Mesh(prim), world_from_local, reading)
    if left_out:
        about = subject or stage.GetRootLayer().identifier
        warn(f"{about}: only meshes are taken; left out: {paths_of(left_out)}.")
    return tuple(surfaces)


def paths_of(prims: Sequence[Usd.Prim]) -> str:
    """The first of some prims for a sentence: path and type, and how many more there are."""
    shown = [f"<{prim.GetPath()}> ({prim.GetTypeName()})" for prim in prims[:_MAX_SHOWN]]
    more = len(prims) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def metres_from_units(stage: Usd.Stage) -> Double:
    """(4, 4) scale from the stage's units to metres."""
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    return np.diag([meters, meters, meters, 1.0])


def _surfaces_of_mesh(
    mesh: UsdGeom.Mesh, world_from_local: Double, reading: _Reading
) -> list[Surface]:
    time, warn = reading.time, reading.warn
    points = np.asarray(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    fans = triangulation_of(mesh)
    if not len(fans.triangles) or fans.triangles.max() >= len(points):
        warn(f"<{mesh.GetPath()}>: the mesh has no faces, or faces without points; left out.")
        return []
    if not np.isfinite(points).all():
        raise InputRefused(
            f"<{mesh.GetPath()}>: the mesh has points that are not finite. Repair or deactivate "
            "it. [relight.mesh]"
        )
    normals = _normals(mesh, fans, time)
    if normals is None:
        normals = corner_normals(np.asarray(points, np.float32), fans.triangles, _CREASE_ANGLE_DEG)
    parts = []
    for faces, material in _faces_by_material(mesh, fans, reading):
        colour = _primvar(mesh, material.colour_primvar, 3, fans, time)
        uv = _primvar(mesh, material.uv_primvar, 2, fans, time)
        if uv is None and material.uv_primvar:
            warn(f"<{mesh.GetPath()}>: no primvars:{material.uv_primvar} for its textures.")
        parts.append(
            Surface(
                name=str(mesh.GetPath()),
                points=points,
                triangles=fans.triangles[faces],
                corner_normals=normals[faces],
                corner_uv=None if uv is None else material.transformed(uv[faces]),
                corner_colour=None if colour is None else colour[faces],
                material=material.material if colour is None else material.without_diffuse,
                two_sided=bool(mesh.GetDoubleSidedAttr().Get(time)),
            )
        )
    metres = metres_from_units(mesh.GetPrim().GetStage())
    return [_tidy(part).moved(metres @ world_from_local) for part in parts]


def _tidy(part: Surface) -> Surface:
    """Without the points that its triangles do not use."""
    used, triangles = np.unique(part.triangles, return_inverse=True)
    return replace(
        part, points=part.points[used], triangles=np.asarray(triangles, np.int32).reshape(-1, 3)
    )


def _faces_by_material(
    mesh: UsdGeom.Mesh, fans: Triangulation, reading: _Reading
) -> list[tuple[npt.NDArray[np.intp], BoundMaterial]]:
    """Triangles of each bound material; what no subset claims has the mesh's own."""
    own = UsdShade.MaterialBindingAPI(mesh.GetPrim())
    rest = np.ones(len(fans.triangles), np.bool_)
    found = []
    for subset in own.GetMaterialBindSubsets():
        polygons = np.asarray(subset.GetIndicesAttr().Get(reading.time) or [], np.int32)
        chosen = np.isin(fans.polygon, polygons) & rest
        rest &= ~chosen
        if chosen.any():
            bound = UsdShade.MaterialBindingAPI(subset.GetPrim())
            found.append((np.flatnonzero(chosen), _bound(bound, reading)))
    if rest.any():
        found.append((np.flatnonzero(rest), _bound(own, reading)))
    return found


def _bound(binding: UsdShade.MaterialBindingAPI, reading: _Reading) -> BoundMaterial:
    material, _ = binding.ComputeBoundMaterial()
    mapping = reading.mappings.get(str(material.GetPath()), "") if material else ""
    return material_from_usd(material, reading.time, reading.warn, mapping)


def _normals(mesh: UsdGeom.Mesh, fans: Triangulation, time: Usd.TimeCode) -> Float | None:
    """(T, 3, 3) authored unit normals; None where there are none to use."""
    authored = authored_normals(mesh, fans, time)
    if authored is None:
        return None
    normals = np.asarray(authored, np.float32)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True), np.float32)


def _primvar(
    mesh: UsdGeom.Mesh, name: str, width: int, fans: Triangulation, time: Usd.TimeCode
) -> Float | None:
    """(T, 3, width) values of a primvar, inherited ones too; None where it has none to use."""
    primvar = UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(name) if name else None
    if not primvar or not primvar.HasValue():
        return None
    rows = np.asarray(primvar.ComputeFlattened(time) or [], np.float32)
    if not rows.size or rows.size % width:
        return None
    rows = rows.reshape(-1, width)
    row_of_corner = fans.element_of_corner(primvar.GetInterpolation())
    # Too few of them: the file is wrong about these values, not about its shape.
    return rows[row_of_corner] if row_of_corner.max() < len(rows) else None
