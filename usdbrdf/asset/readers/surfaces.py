"""The composed stage as a renderer sees it: every visible mesh in the world, with its material:
UsdPreviewSurface networks, as they compose, into maps and numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdbrdf.asset.preview_lobe import BECKMANN_FACETS, MICROFACET, fit_from_preview_surface
from usdbrdf.asset.readers.scene import (
    asset_file,
    authored,
    authored_normals,
    per_corner,
    triangulation_of,
)
from usdbrdf.errors import InputRefused, first_of
from usdbrdf.files.colour import to_working_space
from usdbrdf.files.images import image_size, is_eight_bit, read_exr, read_radiance
from usdbrdf.geometry.normals import corner_normals
from usdbrdf.model.arrays import Double, Float
from usdbrdf.model.material import Material, Surface, constant_map, preview_material
from usdbrdf.model.mesh import Triangulation
from usdbrdf.transport.brdf import BECKMANN, CONDUCTOR, DIELECTRIC, PAPER
from usdbrdf.transport.renderer_match import shown_share_of_metal
from usdbrdf.untrusted.usd_files import numbers_of

# The fallbacks of UsdPreviewSurface, which also stand for a mesh without any material.
_FALLBACKS: dict[str, tuple[float, ...]] = {
    "diffuseColor": (0.18, 0.18, 0.18),
    "emissiveColor": (0.0, 0.0, 0.0),
    "specularColor": (0.0, 0.0, 0.0),
    "metallic": (0.0,),
    "roughness": (0.5,),
    "ior": (1.5,),
    "useSpecularWorkflow": (0.0,),
    "opacity": (1.0,),
}
# "black" and its synonym "useMetadata" are the same as "clamp" but beyond uv of 0 to 1.
_WRAP = {"repeat": "repeat", "mirror": "mirror"}
# Meshes that bring no normals are smooth where their faces meet at less than this.
_CREASE_ANGLE_DEG = 40.0
# Prims that a sentence names.
_MAX_SHOWN = 5
_PURPOSES = (UsdGeom.Tokens.default_, UsdGeom.Tokens.render)
_CHANNEL = {"r": 0, "g": 1, "b": 2}


@dataclass(kw_only=True)
class _MaterialReader:
    """Reads the surface of a material, and gathers which primvars of a mesh that leads to."""

    time: Usd.TimeCode
    warn: Callable[[str], None]
    uv_primvar: str = ""  # "" for none
    colour_primvar: str = ""
    uv_from_st: Float | None = None  # (3, 3) of column vectors, a UsdTransform2d; None: identity
    wrap: str = ""

    def material(self, bound: UsdShade.Material, mapping: str, lobe: str = "") -> Material:
        """The material as bound; without one, or without a UsdPreviewSurface in it, the fallbacks
        of UsdPreviewSurface with the mesh's display colour.

        mapping  "matched" or "microfacet" if the surface was told what renderers need to show a
                 fitted lobe: what comes back is the lobe that was meant. A map of roughness counts
                 by its mean.
        lobe     whose equations the fitted numbers are of, "microfacet", "beckmann" or the paper's
                 Half metals and the specular workflow are never ours: those stay as they are
        """
        shader = bound.ComputeSurfaceSource()[0] if bound else None
        path = bound.GetPath() if bound else ""
        if not shader or shader.GetShaderId() != "UsdPreviewSurface":
            if bound:
                self.warn(f"<{path}>: no UsdPreviewSurface; shown in its display colour.")
            shader, mapping, self.colour_primvar = None, "", "displayColor"
        known = {
            name: self._read(shader.GetInput(name) if shader else None, fallback)
            for name, fallback in _FALLBACKS.items()
        }
        clear = not known["opacity"].any()
        if known["opacity"].min() < 1 and not clear:
            self.warn(f"<{path}>: opacity is not rendered; the surface is taken as opaque.")
        ior, roughness = float(known["ior"].flat[0]), float(known["roughness"].mean())
        fitted_by = ("matched", MICROFACET)
        ours = mapping in fitted_by and not known["useSpecularWorkflow"].any()
        if ours and mapping == "matched" and (known["metallic"] == 1).all():
            share = shown_share_of_metal(roughness**2)
            known["diffuseColor"] = np.minimum(known["diffuseColor"] / np.float32(share), 1)
        elif ours and not known["metallic"].any():
            fitted = fit_from_preview_surface(roughness, ior, mapping)
            known["diffuseColor"] = np.asarray(known["diffuseColor"] / fitted.diffuse, np.float32)
            ior = fitted.ior
        material = preview_material(
            diffuse=known["diffuseColor"],
            metallic=known["metallic"],
            roughness=known["roughness"],
            emission=known["emissiveColor"],
            ior=ior,
            specular=known["specularColor"] if known["useSpecularWorkflow"].flat[0] else None,
        )
        kind = DIELECTRIC if MICROFACET in (mapping, lobe) else PAPER
        kind = BECKMANN if lobe == BECKMANN_FACETS else kind
        if kind != PAPER and known["useSpecularWorkflow"].any():
            kind = CONDUCTOR  # any reflectance, which Fresnel's equations of a dielectric have not
        normal = self._normal(shader.GetInput("normal") if shader else None)
        return replace(material, wrap=self.wrap or "clamp", lobe=kind, clear=clear, normal=normal)

    def _normal(self, wanted: UsdShade.Input | None) -> Float | None:
        """(H, W, 3): a map of normals that lies as the other maps do; None without one."""
        own = _MaterialReader(time=self.time, warn=self.warn)
        found = own._read(wanted, (0.0, 0.0, 1.0))
        if found.shape[:2] == (1, 1):
            return None
        if not self.uv_primvar:
            self.uv_primvar, self.uv_from_st, self.wrap = own.uv_primvar, own.uv_from_st, own.wrap
        here, there = (np.eye(3) if m is None else m for m in (self.uv_from_st, own.uv_from_st))
        if own.uv_primvar == self.uv_primvar and np.array_equal(here, there):
            return found
        assert wanted is not None
        self.warn(
            f"<{wanted.GetAttr().GetPath()}>: the map of normals has other coordinates than the "
            "material's other maps, and is not shown."
        )
        return None

    def _read(self, wanted: UsdShade.Input | None, fallback: tuple[float, ...]) -> Float:
        """(H, W, 1 or 3) float32: a texture's texels, or 1 x 1 of a constant."""
        plain = np.array(fallback, np.float32)[None, None]
        source = _source(wanted)
        if source is None:
            return self._numbers(wanted, fallback)[None, None]
        shader, output = source
        kind = shader.GetShaderId()
        if kind == "UsdUVTexture":
            return self._texture(shader, output, len(fallback))
        if kind == "UsdPrimvarReader_float3" and len(fallback) == 3:
            self.colour_primvar = str(_value(shader.GetInput("varname"), self.time) or "")
            return plain
        self.warn(f"<{shader.GetPath()}>: {kind or 'a node'} is not rendered; its input is.")
        return plain

    def _texture(self, shader: UsdShade.Shader, output: str, channels: int) -> Float:
        source = _source(shader.GetInput("st"))
        if source is not None and source[0].GetShaderId() == "UsdTransform2d":
            # Scale, then rotate counter-clockwise, then translate.
            node = source[0]
            turn = np.radians(self._numbers(node.GetInput("rotation"), (0,))[0])
            scale = self._numbers(node.GetInput("scale"), (1, 1))
            matrix = np.eye(3, dtype=np.float32)
            matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]] * scale
            matrix[:2, 2] = self._numbers(node.GetInput("translation"), (0, 0))
            self.uv_from_st, source = matrix, _source(node.GetInput("in"))
        if source is not None:
            self.uv_primvar = str(_value(source[0].GetInput("varname"), self.time) or "st")
        modes = [str(_value(shader.GetInput(name), self.time)) for name in ("wrapS", "wrapT")]
        found = [_WRAP.get(mode, "clamp") for mode in modes]
        self.wrap = self.wrap or found[0]
        if {*found} != {self.wrap}:
            self.warn(
                f"<{shader.GetPath()}>: one mode of wrapping is rendered for all textures of a "
                f"material; it is {self.wrap!r}."
            )
        unread = self._numbers(shader.GetInput("fallback"), (0, 0, 0, 1))
        named = shader.GetInput("file")
        file = asset_file(_producer(named), self.time) if named else None
        space = str(_value(shader.GetInput("sourceColorSpace"), self.time) or "auto")
        if file is None or not file.is_file():
            self.warn(f"<{shader.GetPath()}>: there is no file {file}; its fallback is shown.")
            texels = unread[None, None, :3]
        else:
            texels = read_texture(file, space)
        texels = texels * self._numbers(shader.GetInput("scale"), (1, 1, 1, 1))[:3]
        texels = texels + self._numbers(shader.GetInput("bias"), (0, 0, 0, 0))[:3]
        if channels == 1:
            texels = texels[..., [_CHANNEL.get(output, 0)]]
        return np.ascontiguousarray(texels, np.float32)

    def _numbers(self, wanted: UsdShade.Input | None, fallback: tuple[float, ...]) -> Float:
        """(N,) float32 of a plain value; the fallback where it has another type or is not
        finite."""
        value, usable = _value(wanted, self.time), np.array(fallback, np.float32)
        if wanted is None or value is None:
            return usable
        try:
            numbers = np.array(value, np.float32).ravel()
        except (TypeError, ValueError):
            numbers = np.empty(0, np.float32)
        if numbers.size == usable.size and np.isfinite(numbers).all():
            return numbers
        self.warn(
            f"<{wanted.GetAttr().GetPath()}>: {value!r} is not {usable.size} finite number(s); "
            "its fallback is shown."
        )
        return usable


def read_texture(file: Path, space: str) -> Float:
    """(H, W, 3) float32 linear Rec.709; ``space`` is UsdUVTexture's: raw, sRGB or auto."""
    if len(image_size(file)[2]) >= 3:
        texels = read_radiance(file)
    else:
        texels = np.repeat(read_exr(file)[..., :1], 3, axis=2)
    texels = np.nan_to_num(texels, nan=0.0, posinf=0.0, neginf=0.0)
    return to_working_space(texels, "srgb_rec709_scene") if is_srgb(file, space) else texels


def is_srgb(file: Path, space: str) -> bool:
    """Whether a texture's values are sRGB, where UsdUVTexture is told raw, sRGB or auto: this last
    is sRGB for bytes of three or four channels."""
    if space == "auto":
        return is_eight_bit(file) and len(image_size(file)[2]) >= 3
    return space == "sRGB"


def _source(wanted: UsdShade.Input | None) -> tuple[UsdShade.Shader, str] | None:
    """The node that an input is connected to, also through a material's interface, and which of
    its outputs; None where a plain value feeds it."""
    if not wanted:
        return None
    for attribute in wanted.GetValueProducingAttributes():
        if UsdShade.Output.IsOutput(attribute):
            return UsdShade.Shader(attribute.GetPrim()), attribute.GetName().split(":")[-1]
    return None


def _producer(wanted: UsdShade.Input) -> Usd.Attribute:
    producers = wanted.GetValueProducingAttributes()
    return producers[0] if producers else wanted.GetAttr()


def _value(wanted: UsdShade.Input | None, time: Usd.TimeCode) -> Any:
    if not wanted:
        return None
    value = _producer(wanted).Get(time)
    return value.path if isinstance(value, Sdf.AssetPath) else value


def surfaces_from_stage(
    stage: Usd.Stage, time: Usd.TimeCode, warn: Callable[[str], None], subject: Path | None = None
) -> tuple[Surface, ...]:
    """All active, visible meshes, in metres in the stage's world, split where subsets of their
    faces are bound to other materials. Subdivision cages are taken as the surface.

    warn     is told, in sentences, what was left out
    subject  what these sentences are about; None: the stage's root layer
    """
    surfaces: list[Surface] = []
    left_out: list[Usd.Prim] = []
    prims = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    # What a fit recorded of the materials that its objects are bound to: mapping and lobe.
    mappings = {
        str(bound.GetPath()): (str(mapping), str(authored(prim, "usdBrdf:fit:lobe") or ""))
        for prim in prims
        if (mapping := authored(prim, "usdBrdf:fit:mapping")) is not None
        if (bound := UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0])
    }
    transforms = UsdGeom.XformCache(time)
    for prim in prims:
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
        surfaces += _surfaces_of_mesh(UsdGeom.Mesh(prim), world_from_local, time, mappings, warn)
    if left_out:
        about = subject or stage.GetRootLayer().identifier
        warn(f"{about}: only meshes are taken; left out: {paths_of(left_out)}.")
    return tuple(surfaces)


def paths_of(prims: Sequence[Usd.Prim]) -> str:
    """The first of some prims for a sentence: path and type, and how many more there are."""
    return first_of([f"<{prim.GetPath()}> ({prim.GetTypeName()})" for prim in prims], _MAX_SHOWN)


def metres_from_units(stage: Usd.Stage) -> Double:
    """(4, 4) scale from the stage's units to metres."""
    meters = UsdGeom.GetStageMetersPerUnit(stage)
    return np.diag([meters, meters, meters, 1.0])


def _surfaces_of_mesh(
    mesh: UsdGeom.Mesh,
    world_from_local: Double,
    time: Usd.TimeCode,
    mappings: Mapping[str, tuple[str, str]],
    warn: Callable[[str], None],
) -> list[Surface]:
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
    given = authored_normals(mesh, fans, time)
    if given is None:
        normals = corner_normals(np.asarray(points, np.float32), fans.triangles, _CREASE_ANGLE_DEG)
    else:
        normals = np.asarray(given, np.float32)
        normals = np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True), np.float32)
    metres = metres_from_units(mesh.GetPrim().GetStage())
    surfaces = []
    for faces, bound in _faces_by_material(mesh, fans, time):
        reader = _MaterialReader(time=time, warn=warn)
        mapping, lobe = mappings.get(str(bound.GetPath()), ("", "")) if bound else ("", "")
        material = reader.material(bound, mapping, lobe)
        colour = _primvar(mesh, reader.colour_primvar, 3, fans, time)
        if colour is not None:
            material = replace(material, diffuse=constant_map(1.0), base=None, metallic=None)
        uv = _primvar(mesh, reader.uv_primvar, 2, fans, time)
        if uv is None and reader.uv_primvar:
            warn(f"<{mesh.GetPath()}>: no primvars:{reader.uv_primvar} for its textures.")
        elif uv is not None and (moved := reader.uv_from_st) is not None:
            uv = np.asarray(uv @ moved[:2, :2].T + moved[:2, 2], np.float32)
        used, triangles = np.unique(fans.triangles[faces], return_inverse=True)
        surface = Surface(
            name=str(mesh.GetPath()),
            points=points[used],
            triangles=np.asarray(triangles, np.int32).reshape(-1, 3),
            corner_normals=normals[faces],
            corner_uv=None if uv is None else uv[faces],
            corner_colour=None if colour is None else colour[faces],
            material=material,
            two_sided=bool(mesh.GetDoubleSidedAttr().Get(time)),
        )
        surfaces.append(surface.moved(metres @ world_from_local))
    return surfaces


def _faces_by_material(
    mesh: UsdGeom.Mesh, fans: Triangulation, time: Usd.TimeCode
) -> Iterator[tuple[npt.NDArray[np.intp], UsdShade.Material]]:
    """Triangles of each bound material; what no subset claims has the mesh's own."""
    own = UsdShade.MaterialBindingAPI(mesh.GetPrim())
    rest = np.ones(len(fans.triangles), np.bool_)
    for subset in own.GetMaterialBindSubsets():
        polygons = numbers_of(subset.GetIndicesAttr().Get(time), np.int32)
        chosen = np.isin(fans.polygon, polygons) & rest
        rest &= ~chosen
        if chosen.any():
            bound = UsdShade.MaterialBindingAPI(subset.GetPrim())
            yield np.flatnonzero(chosen), bound.ComputeBoundMaterial()[0]
    if rest.any():
        yield np.flatnonzero(rest), own.ComputeBoundMaterial()[0]


def _primvar(
    mesh: UsdGeom.Mesh, name: str, width: int, fans: Triangulation, time: Usd.TimeCode
) -> Float | None:
    """(T, 3, width) values of a primvar, inherited ones too; None where it has none to use."""
    primvar = UsdGeom.PrimvarsAPI(mesh).FindPrimvarWithInheritance(name) if name else None
    if not primvar or not primvar.HasValue():
        return None
    rows = numbers_of(primvar.ComputeFlattened(time), np.float32, width)
    if not rows.size:
        return None
    return per_corner(rows.reshape(-1, width), np.float32, primvar.GetInterpolation(), fans)
