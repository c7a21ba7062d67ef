"""A package's meshes with fewer triangles, for viewers that need little geometry: each is reduced,
unwrapped anew, and given the maps of the scan and its normals, by rays from the one to the other.

What was measured stays in the asset; numbers of the package's prims are those of the scan."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.surfaces import metres_from_units, read_texture, surfaces_from_stage
from usdbrdf.delivery.packaged_files import TextureUse, produced, set_input, texture_uses
from usdbrdf.files.images import image_size, needs_float, write_exr
from usdbrdf.geometry.mesh_clean import decimated
from usdbrdf.geometry.normal_maps import (
    at,
    corner_tangents,
    from_tangent_space,
    in_tangent_space,
    interpolated,
    nearest_of,
    sampled,
    seen_along_normals,
    unit,
)
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.geometry.texels import texels_from_atlas
from usdbrdf.geometry.unwrap import TexelSizes, unwrap
from usdbrdf.model.arrays import Double, Float, Int
from usdbrdf.model.material import Surface
from usdbrdf.model.mesh import compact, doubled_areas, joined
from usdbrdf.model.scene import Scene, SceneObject
from usdbrdf.model.texels import Texels
from usdbrdf.transport.rays import RayScene

Types = Sdf.ValueTypeNames
READER, NORMALS = "LowPolyStReader", "NormalTexture"
# How far the scan may lie from the coarse surface, as a share of the box around the object.
_REACH = 0.05
# Coarse faces that lean more than this from each other have an edge between them.
CREASE_ANGLE_DEG = 60.0
# Texels of an object, whose points take some 200 bytes each.
_MOST_TEXELS = 1 << 23
_PURPOSES = (UsdShade.Tokens.full, UsdShade.Tokens.preview)
_OF_FACES = (
    "cornerIndices", "cornerSharpnesses", "creaseIndices", "creaseLengths", "creaseSharpnesses",
    "holeIndices", "velocities", "accelerations", "normals",
)  # fmt: skip


class _Part(NamedTuple):
    """A mesh that is reduced: what it was, in the world in metres, and its material."""

    surface: Surface
    material: UsdShade.Material


class _Baked(NamedTuple):
    """Where the texels of a coarse mesh lie in the maps of the scan.

    texels  of one object
    uv      (T, 2) float32, None where the scan has no maps
    normal  (T, 3) float32, in tangent space; z where no point of the scan was met
    """

    texels: Texels
    uv: Float | None
    normal: Float


def make_low_poly(
    flat: Usd.Stage, asset: Asset, folder: Path, wanted: float, warn: Callable[[str], None]
) -> int:
    """Reduce the meshes of a flattened stage; returns how many triangles there are then.

    folder  for the textures that are made, until they are packed
    wanted  about as many triangles in all; below 1 that share of what there is

    Meshes that the scan's maps cannot be carried over for, and those that have few triangles
    already, stay as they are; ``warn`` is told of the former.
    """
    surfaces = surfaces_from_stage(flat, Usd.TimeCode.EarliestTime(), lambda said: None)
    given = sum(len(surface.triangles) for surface in surfaces)
    target = max(1, round(wanted * given if wanted < 1 else wanted))
    if given <= target:
        warn(f"--low-poly {wanted:g}: the asset has {given:,} triangles, which stay as they are.")
        return given
    parts = _parts(flat, asset, surfaces, warn)
    rest = given - sum(len(part.surface.triangles) for part in parts)
    if not parts:
        return given
    coarse = _reduced([part.surface for part in parts], max(1, target - rest), str(asset.folder))
    coarser = [i for i, (part, (_, own)) in enumerate(zip(parts, coarse, strict=True))
               if len(own) < len(part.surface.triangles)]  # fmt: skip
    parts, meshes = [parts[i] for i in coarser], [coarse[i] for i in coarser]
    count = given - sum(len(part.surface.triangles) for part in parts)
    if parts:
        uses = texture_uses(flat, asset)
        for i, (own, size) in enumerate(_unwrapped(parts, meshes, uses)):
            place = folder / f"{i:04d}"
            place.mkdir()
            count += _replace(flat, parts[i], own, size, uses, place, warn)
    _measure_boxes(flat)
    return count


def _parts(
    flat: Usd.Stage, asset: Asset, surfaces: Sequence[Surface], warn: Callable[[str], None]
) -> list[_Part]:
    """The meshes that can be reduced, each with a material of its own."""
    of_mesh = Counter(surface.name for surface in surfaces)
    alpha = {Sdf.Path(use.prim_path) for use in texture_uses(flat, asset) if use.reads_alpha}
    used: set[Sdf.Path] = set()
    parts, left = [], []
    for surface in surfaces:
        material, why = _material(flat, surface, of_mesh[surface.name] > 1, alpha)
        if material is not None and material.GetPath() in used:
            material = _copied(flat, surface.name, material)
            why = "" if material else "shares a material that others bind for it"
        if material is None:
            left.append(f"<{surface.name}> {why}")
            continue
        used.add(material.GetPath())
        parts.append(_Part(surface, material))
    if left:
        shown = dict.fromkeys(left)
        more = f", and {len(shown) - 5} more" if len(shown) > 5 else ""
        warn(f"--low-poly: meshes that stay as they are: {'; '.join([*shown][:5])}{more}.")
    return parts


def _material(
    flat: Usd.Stage, surface: Surface, divided: bool, alpha: set[Sdf.Path]
) -> tuple[UsdShade.Material | None, str]:
    """The material that a mesh is bound to; or None, and what keeps it from being reduced."""
    prim = flat.GetPrimAtPath(surface.name)
    binding = UsdShade.MaterialBindingAPI(prim)
    material = binding.ComputeBoundMaterial()[0]
    others = [binding.ComputeBoundMaterial(purpose)[0] for purpose in _PURPOSES]
    shader = material.ComputeSurfaceSource()[0] if material else None
    points = UsdGeom.Mesh(prim).GetPointsAttr()
    inside = Usd.PrimRange(material.GetPrim()) if material else []
    below = [UsdShade.Shader(each) for each in inside if each.IsA(UsdShade.Shader)]
    coordinates = {_where(node) for node in below if node.GetShaderId() == "UsdUVTexture"}
    problems = {
        "has several materials": divided,
        "has no UsdPreviewSurface": not shader or shader.GetShaderId() != "UsdPreviewSurface",
        "has a material with nodes elsewhere": bool(material) and _has_nodes_elsewhere(material),
        "has other materials for other purposes": any(
            other and other.GetPath() != material.GetPath() for other in others
        ),
        "shows colours of its vertices": surface.corner_colour is not None,
        "reads values of its vertices": any(
            str(node.GetShaderId()).startswith("UsdPrimvarReader_")
            and node.GetShaderId() != "UsdPrimvarReader_float2"
            for node in below
        ),
        "has textures at several coordinates": len(coordinates) > 1,
        "has textures and no coordinates": bool(coordinates) and surface.corner_uv is None,
        "has a texture whose alpha is used": bool(material)
        and any(path.HasPrefix(material.GetPath()) for path in alpha),
        "is animated": points.GetNumTimeSamples() > 1,
        "is flattened by its transform": abs(np.linalg.det(_world_from_local(prim)[:3, :3]))
        < 1e-30,
    }
    why = next((said for said, found in problems.items() if found), "")
    return (None, why) if why else (material, "")


def _has_nodes_elsewhere(material: UsdShade.Material) -> bool:
    """Whether its network goes on outside of it, where other materials may share it."""
    inside = Usd.PrimRange(material.GetPrim())
    sources = (path for prim in inside for each in prim.GetAttributes()
               for path in each.GetConnections())  # fmt: skip
    return any(not path.HasPrefix(material.GetPath()) for path in sources)


def _where(node: UsdShade.Shader, name: str = "st") -> tuple[object, ...]:
    """What a texture's coordinates are made of."""
    wanted = node.GetInput(name)
    sources = wanted.GetConnectedSources()[0] if wanted else []
    if not sources:
        return ()
    source = UsdShade.Shader(sources[0].source.GetPrim())
    told = [str(produced(source, n)) for n in ("varname", "rotation", "scale", "translation")]
    return (source.GetShaderId(), *told, *_where(source, "in"))


def _copied(flat: Usd.Stage, mesh: str, material: UsdShade.Material) -> UsdShade.Material | None:
    """A material for one mesh alone, bound; None where that binding does not win."""
    layer, path = flat.GetRootLayer(), Sdf.Path(mesh)
    name, number = f"{material.GetPrim().GetName()}_{path.name}", 2
    while flat.GetPrimAtPath(place := material.GetPath().GetParentPath().AppendChild(name)):
        name, number = f"{material.GetPrim().GetName()}_{path.name}_{number}", number + 1
    Sdf.CopySpec(layer, material.GetPath(), layer, place)
    own, prim = UsdShade.Material(flat.GetPrimAtPath(place)), flat.GetPrimAtPath(path)
    before = UsdShade.MaterialBindingAPI(prim).GetDirectBindingRel().GetTargets()
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(own)
    if UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0].GetPath() == place:
        return own
    UsdShade.MaterialBindingAPI(prim).GetDirectBindingRel().SetTargets(before)
    flat.RemovePrim(place)
    return None


def _reduced(surfaces: Sequence[Surface], target: int, label: str) -> list[tuple[Float, Int]]:
    """Points and triangles of each surface, of about ``target`` triangles in all."""
    points, triangles, owner = joined(
        [(surface.points.astype(np.float32), surface.triangles) for surface in surfaces]
    )
    if target < len(triangles):
        points, triangles, owner = decimated(
            points, triangles, owner, target, label=label, keep_borders=False
        )
    return [compact(points, triangles[owner == i])[1:] for i in range(len(surfaces))]


def _unwrapped(
    parts: Sequence[_Part], meshes: Sequence[tuple[Float, Int]], uses: Sequence[TextureUse]
) -> list[tuple[Scene, Int]]:
    """Each coarse mesh as a scene of one object, with texture coordinates and normals, and the size
    (1, 2) of its textures; their texels are as large as the scan's."""
    points, triangles, owner = joined(meshes)
    first = np.cumsum([0, *(len(own) for _, own in meshes)])
    scene = Scene(
        objects=tuple(_object(part.surface.name, int(first[i]), len(meshes[i][1]))
                      for i, part in enumerate(parts)),
        points=points,
        triangles=triangles,
        corner_normals=corner_normals(points, triangles, CREASE_ANGLE_DEG),
        face_object=owner,
    )  # fmt: skip
    sides = np.array([_texel_side(part, uses) for part in parts], np.float32)
    unseen = np.zeros(len(triangles), np.float32)
    corner_uv, resolution = unwrap(scene, TexelSizes(sides[owner], unseen))
    found = []
    for i, (own_points, own) in enumerate(meshes):
        faces = slice(first[i], first[i + 1])
        one = replace(
            scene,
            objects=(_object(parts[i].surface.name, 0, len(own)),),
            points=own_points,
            triangles=own,
            corner_normals=corner_normals(own_points, own, CREASE_ANGLE_DEG),
            face_object=np.zeros(len(own), np.int32),
            corner_uv=corner_uv[faces],
        )
        found.append((one, resolution[i : i + 1]))
    return found


def _object(path: str, first: int, count: int) -> SceneObject:
    return SceneObject(
        prim_path=path, identifier=path, label="", class_name="", first_face=first, num_faces=count
    )


def _texel_side(part: _Part, uses: Sequence[TextureUse]) -> float:
    """Metres: the finest of the scan's textures, and half of the scan's edges for its normals."""
    surface = part.surface
    area = float(doubled_areas(surface.points, surface.triangles).sum()) / 2
    side = math.sqrt(2 * area / len(surface.triangles)) / 2
    if surface.corner_uv is not None:
        flat = (surface.corner_uv[:, 1:] - surface.corner_uv[:, :1]).astype(np.float64)
        covered = float(np.abs(np.linalg.det(flat)).sum()) / 2
        for use in _of_material(part.material, uses):
            width, height, _ = image_size(use.file)
            if covered > 0:
                side = min(side, math.sqrt(area / (covered * width * height)))
    return max(side, math.sqrt(area / _MOST_TEXELS), 1e-9)


def _of_material(material: UsdShade.Material, uses: Sequence[TextureUse]) -> list[TextureUse]:
    path = material.GetPath()
    return [use for use in uses if Sdf.Path(use.prim_path).HasPrefix(path)]


def _replace(
    flat: Usd.Stage, part: _Part, own: Scene, resolution: Int, uses: Sequence[TextureUse],
    folder: Path, warn: Callable[[str], None],
) -> int:  # fmt: skip
    """Put the coarse mesh and textures of its own in the place of the scan's; returns the number of
    its triangles."""
    baked = _baked(part.surface, own, resolution)
    if baked is None:
        warn(f"<{part.surface.name}>: no ray from the reduced mesh meets the scan; it stays.")
        return len(part.surface.triangles)
    reader = part.material.GetPath().AppendChild(READER)
    st = UsdShade.Shader.Define(flat, reader)
    st.CreateIdAttr("UsdPrimvarReader_float2")
    set_input(st, "varname", Types.String, "st")
    wrap = part.surface.material.wrap
    for number, use in enumerate(_of_material(part.material, uses)):
        if baked.uv is None or "normal" in use.feeds:
            continue
        channels = 3 if len(image_size(use.file)[2]) >= 3 else 1
        pixels = sampled(read_texture(use.file, use.space)[..., :channels], baked.uv, wrap)
        file = folder / f"{number:02d}.{use.file.stem}.exr"
        encoding = "lin_rec709_scene" if use.colour else "data"
        picture = baked.texels.image(0, pixels)
        write_exr(file, picture, half=not needs_float(picture), encoding=encoding)
        _read(UsdShade.Shader(flat.GetPrimAtPath(use.prim_path)), file, st)
    file = folder / f"{Sdf.Path(part.surface.name).name}.normal.exr"
    stored = (baked.normal + np.float32(1)) / np.float32(2)
    write_exr(file, baked.texels.image(0, stored), encoding="data")
    normals = UsdShade.Shader.Define(flat, part.material.GetPath().AppendChild(NORMALS))
    normals.CreateIdAttr("UsdUVTexture")
    set_input(normals, "scale", Types.Float4, Gf.Vec4f(2, 2, 2, 1))
    set_input(normals, "bias", Types.Float4, Gf.Vec4f(-1, -1, -1, 0))
    set_input(normals, "fallback", Types.Float4, Gf.Vec4f(0.5, 0.5, 1, 1))
    _read(normals, file, st)
    shown = part.material.ComputeSurfaceSource()[0].CreateInput("normal", Types.Normal3f)
    shown.ClearSources()
    shown.ConnectToSource(normals.CreateOutput("rgb", Types.Float3))
    _author_mesh(flat.GetPrimAtPath(part.surface.name), own)
    return len(own.triangles)


def _read(texture: UsdShade.Shader, file: Path, st: UsdShade.Shader) -> None:
    """Make a node read a file of ours, at the coarse mesh's coordinates."""
    set_input(texture, "file", Types.Asset, Sdf.AssetPath(str(file)))
    for name, value in (("sourceColorSpace", "raw"), ("wrapS", "clamp"), ("wrapT", "clamp")):
        set_input(texture, name, Types.Token, value)
    wanted = texture.CreateInput("st", Types.Float2)
    wanted.ClearSources()
    wanted.ConnectToSource(st.CreateOutput("result", Types.Float2))


def _baked(surface: Surface, own: Scene, resolution: Int) -> _Baked | None:
    """None where no texel meets the scan."""
    assert own.corner_uv is not None
    fine = RayScene(surface.points.astype(np.float32), surface.triangles)
    texels = texels_from_atlas(own, resolution)
    reach = _REACH * float(np.linalg.norm(np.ptp(surface.points, axis=0)))
    hits, met = seen_along_normals(fine, texels.position, texels.normal, reach)
    if not met.any():
        return None
    hits = at(hits, nearest_of(texels.position, met))
    normals = unit(interpolated(surface.corner_normals, hits))
    uv = None if surface.corner_uv is None else interpolated(surface.corner_uv, hits)
    bumps = surface.material.normal
    if bumps is not None and surface.corner_uv is not None and uv is not None:
        frame = corner_tangents(
            surface.points, surface.triangles, surface.corner_normals, surface.corner_uv
        )
        local = sampled(bumps, uv, surface.material.wrap)
        normals = from_tangent_space(local, normals, interpolated(frame, hits))
    tangents = corner_tangents(own.points, own.triangles, own.corner_normals, own.corner_uv)
    at_texels = np.einsum("tc,tcd->td", texels.barycentric, tangents[texels.face])
    local = in_tangent_space(normals, texels.normal, at_texels)
    local[~met] = (0, 0, 1)
    return _Baked(texels, uv, local)


def _world_from_local(prim: Usd.Prim) -> Double:
    """(4, 4) of column vectors, to metres."""
    local_to_world = UsdGeom.Imageable(prim).ComputeLocalToWorldTransform(
        Usd.TimeCode.EarliestTime()
    )
    found: Double = metres_from_units(prim.GetStage()) @ np.array(local_to_world).T
    return found


def _author_mesh(prim: Usd.Prim, own: Scene) -> None:
    """The coarse mesh, which is in the world, as a mesh prim's own; what the prim says of single
    points and faces of the scan goes."""
    assert own.corner_uv is not None
    world_from_local = _world_from_local(prim)
    inverse = np.linalg.inv(world_from_local)
    order = [0, 2, 1] if np.linalg.det(world_from_local[:3, :3]) < 0 else [0, 1, 2]
    points = (own.points @ inverse[:3, :3].T + inverse[:3, 3]).astype(np.float32)
    normals = own.corner_normals[:, order].reshape(-1, 3) @ world_from_local[:3, :3]
    mesh, primvars = UsdGeom.Mesh(prim), UsdGeom.PrimvarsAPI(prim)
    for child in [each for each in prim.GetChildren() if each.IsA(UsdGeom.Subset)]:
        prim.GetStage().RemovePrim(child.GetPath())
    for primvar in primvars.GetPrimvarsWithAuthoredValues():
        if primvar.GetInterpolation() != UsdGeom.Tokens.constant:
            primvars.RemovePrimvar(primvar.GetName())
    for name in _OF_FACES:
        prim.RemoveProperty(name)
    for attribute in (mesh.GetPointsAttr(), mesh.GetFaceVertexCountsAttr(),
                      mesh.GetFaceVertexIndicesAttr(), mesh.GetExtentAttr()):  # fmt: skip
        attribute.Clear()
    mesh.CreatePointsAttr(points)
    mesh.CreateFaceVertexCountsAttr(np.full(len(own.triangles), 3, np.int32))
    mesh.CreateFaceVertexIndicesAttr(own.triangles[:, order].reshape(-1))
    mesh.CreateExtentAttr(np.stack([points.min(axis=0), points.max(axis=0)]))
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateNormalsAttr(unit(normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying)
    st = primvars.CreatePrimvar("st", Types.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
    values, index = np.unique(own.corner_uv[:, order].reshape(-1, 2), axis=0, return_inverse=True)
    st.Set(values.astype(np.float32))
    st.SetIndices(Vt.IntArray.FromNumpy(index.reshape(-1).astype(np.int32)))


def _measure_boxes(flat: Usd.Stage) -> None:
    """Hints of models about their extent, as it is now."""
    for prim in flat.TraverseAll():
        hint = prim.GetAttribute("extentsHint")
        if hint and hint.HasAuthoredValue():
            model = UsdGeom.ModelAPI(prim)
            boxes = UsdGeom.BBoxCache(
                Usd.TimeCode.EarliestTime(), UsdGeom.Imageable.GetOrderedPurposeTokens()
            )
            model.SetExtentsHint(model.ComputeExtentsHint(boxes))
