"""Rules about materials: what renderers would show otherwise than it was measured."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import PurePosixPath
from typing import Any

from pxr import Gf, Sdf, Usd, UsdShade

from usdbrdf.asset.preview_lobe import CLEAR_GLASS, MICROFACET, preview_surface_from_fit
from usdbrdf.asset.properties import facts_by_attribute
from usdbrdf.asset.readers.scene import authored, stored
from usdbrdf.validation.rule import AssetStage, Fault, Severity, Site, cure, rule

Types = Sdf.ValueTypeNames
_LINEAR_FORMATS = frozenset({".exr", ".hdr"})
_BLACK = Gf.Vec3f(0.0)
# Of numbers that a layer holds as 32-bit floats.
_TOLERANCE = 1e-4
# Fits from before the mapping was recorded have none; of one that is not known nothing can be said.
_MEASURED = "measured"
_MODEL = facts_by_attribute()["usdBrdf:fit:model"]
_MAPPINGS = (_MEASURED, "matched", MICROFACET)
_SHOWN = ("usdBrdf:fit:shownPhi", "usdBrdf:fit:shownPsi")
_RECORD = ("usdBrdf:fit:phi", "usdBrdf:fit:psi", "usdBrdf:fit:mapping")


@cure("sourceColorSpace = raw")
def read_raw(site: Site) -> bool:
    UsdShade.Shader(site).CreateInput("sourceColorSpace", Types.Token).Set("raw")
    return True


@rule(Severity.ERROR, read_raw)
def texture_color_space(scene: AssetStage) -> Iterator[Fault]:
    """Textures in OpenEXR or Radiance files hold linear values and are read as such
    (sourceColorSpace = raw). With auto or sRGB several applications decode them as sRGB, and every
    colour comes out darker.

    Author inputs:sourceColorSpace = raw on the texture, or remove the opinion that says otherwise.
    """
    for shader in _shaders(scene, "UsdUVTexture"):
        file = _input_value(shader, "file")
        suffix = PurePosixPath(file.path).suffix.lower() if file else ""
        space = _input_value(shader, "sourceColorSpace") or "auto"
        if suffix in _LINEAR_FORMATS and space != "raw":
            problem = f"sourceColorSpace is {space}, but @{file.path}@ holds linear values."
            yield Fault(shader.GetPrim(), problem)


def _shaders(scene: AssetStage, identifier: str) -> Iterator[UsdShade.Shader]:
    return chain.from_iterable(scene.shaders(identifier, of_looks=x) for x in (False, True))


@cure("block inputs:specularColor")
def block(site: Site) -> bool:
    site.SetConnections([])
    site.Block()
    return True


@rule(Severity.ERROR, block)
def specular_color(scene: AssetStage) -> Iterator[Fault]:
    """Materials of ours state their reflectance by ior and have no specularColor. The specification
    ignores it while useSpecularWorkflow is 0; Blender and three.js do not, and show a highlight of
    half the strength.

    Remove or block inputs:specularColor; or set useSpecularWorkflow to 1, if the measured
    reflectance is to be replaced."""
    for shader in _shaders(scene, "UsdPreviewSurface"):
        colour = shader.GetInput("specularColor")
        if not colour or _input_value(shader, "useSpecularWorkflow"):
            continue
        if colour.GetAttr().HasAuthoredValue() or colour.HasConnectedSource():
            yield Fault(
                colour.GetAttr(),
                "specularColor is authored, but useSpecularWorkflow is 0: some "
                "applications multiply it onto the reflectance that ior gives.",
            )


@cure("the record as measured; roughness, ior and factor that it stands for")
def show_record(site: Site) -> bool:
    """The record as it was measured, and the material as that record says."""
    scene = AssetStage(site.GetStage())
    if scene.surface_of(site) is None:
        return False
    # What others say of the measurement gives way to what our layers say, be it nothing.
    for name in _RECORD:
        recorded = site.GetAttribute(name)
        if authored(site, name) is not None and not scene.is_measured(recorded):
            specs = recorded.GetPropertyStack(Usd.TimeCode.Default())
            ours = [s.default for s in specs if s.layer in scene.own_layers and s.HasDefaultValue()]
            if ours:
                recorded.Set(ours[0])
            else:
                recorded.Block()
    for shown, value in _contradictions(scene, site):
        scale = shown.GetTypeName() == Types.Float4
        shown.Set(Gf.Vec4f(value, value, value, 1.0) if scale else value)
    return True


@rule(Severity.ERROR, show_record)
def lobe_matches_fit(scene: AssetStage) -> Iterator[Fault]:
    """Roughness, ior and the factor on the colour of an object's material are those that its
    recorded phi and psi stand for under the recorded mapping; of a metal the roughness is, of glass
    all are those of a clear pane. Where
    they differ, the file contradicts itself: somebody edited the record, which changes no picture,
    or a layer of ours. What an artist's layer says about the material is not judged.

    To change how a surface looks author roughness and ior of its material; leave the record of the
    measurement as it is."""
    for item in scene.objects:
        for shown, value in _contradictions(scene, item):
            yield Fault(
                item,
                f"<{shown.GetPath()}> is {_first(shown.Get()):.4g}, but by usdBrdf:fit:phi and "
                f"psi under the mapping {_mapping(item)} it is {value:.4g}.",
            )


def _contradictions(scene: AssetStage, item: Usd.Prim) -> Iterator[tuple[Usd.Attribute, float]]:
    """The attributes of an object's material in our layers that show another lobe than its record
    stands for, and what they should be; what an artist changes on purpose is theirs."""
    surface, (phi, psi) = scene.surface_of(item), (authored(item, name) for name in _RECORD[:2])
    usual = [authored(item, name) for name in _SHOWN]
    phi, psi = (phi, psi) if None in usual else usual
    if surface is None or _mapping(item) not in _MAPPINGS or phi is None or psi is None:
        return
    if not (0 <= phi <= 1 and 0 <= psi <= 1):
        return
    model = stored(item, _MODEL)
    glass, metal = model == "transparent", model == "conductor"
    wanted = CLEAR_GLASS if glass else preview_surface_from_fit(phi, psi, _mapping(item))
    diffuse = None if metal or glass else surface.GetInput("diffuseColor")
    sources = diffuse.GetConnectedSources()[0] if diffuse else []
    scale = UsdShade.Shader(sources[0].source.GetPrim()).GetInput("scale") if sources else None
    roughness, ior = (surface.GetInput(name) for name in ("roughness", "ior"))
    numbers = [(roughness, wanted.roughness), *([] if metal else [(ior, wanted.ior)])]
    shown = [(x.GetAttr(), value) for x, value in numbers if x and not x.HasConnectedSource()]
    if scale:
        shown.append((scale.GetAttr(), wanted.diffuse))
    for attribute, value in shown:
        if scene.is_measured(attribute) and abs(_first(attribute.Get()) - value) > _TOLERANCE:
            yield attribute, value


def _mapping(item: Usd.Prim) -> str:
    return str(authored(item, "usdBrdf:fit:mapping") or _MEASURED)


def _first(value: Any) -> float:
    """A number, or the first of the equal ones of a colour."""
    return float(value[0] if isinstance(value, Gf.Vec4f) else value)


@cure("diffuseColor = black")
def blacken(site: Site) -> bool:
    diffuse = UsdShade.Shader(site).CreateInput("diffuseColor", Types.Color3f)
    diffuse.GetAttr().SetConnections([])
    diffuse.Set(_BLACK)
    return True


@rule(Severity.ERROR, blacken)
def emitter_albedo(scene: AssetStage) -> Iterator[Fault]:
    """The emission map of an emitter is all the light that was seen to leave it. A diffuseColor
    beside it adds what the other lamps would cast on it, a second time.

    Author diffuseColor black without a connection, or edit the emission instead."""
    for item in scene.objects:
        surface = scene.surface_of(item)
        emits = authored(item, "usdBrdf:emitter:radiance") is not None
        if emits and surface and not _is_black(surface):
            yield Fault(
                surface.GetPrim(),
                f"<{item.GetPath()}> emits light, and its emission map is all that leaves it, but "
                "its material has a diffuseColor as well.",
            )


@cure("black, ior 1")
def only_glow(site: Site) -> bool:
    shader = UsdShade.Shader(site)
    shader.CreateInput("ior", Types.Float).Set(1.0)
    shader.CreateInput("roughness", Types.Float).Set(1.0)
    return bool(blacken.apply(site))


@rule(Severity.ERROR, only_glow)
def look_material(scene: AssetStage) -> Iterator[Fault]:
    """Materials of the looks that show maps only glow: black diffuseColor, ior 1. Anything else
    mixes the light of the scene into the map that is looked at.

    Remove the opinions on the materials below the scope of the looks."""
    for shader in scene.shaders("UsdPreviewSurface", of_looks=True):
        ior = shader.GetInput("ior")
        shiny = not ior or ior.Get() is None or abs(float(ior.Get()) - 1.0) > _TOLERANCE
        if shiny or not _is_black(shader):
            what = "ior is not 1" if _is_black(shader) else "diffuseColor is not black"
            problem = f"{what}: light of the scene falls into the picture of the map."
            yield Fault(shader.GetPrim(), problem)


def _is_black(shader: UsdShade.Shader) -> bool:
    diffuse = shader.GetInput("diffuseColor")
    return bool(diffuse and not diffuse.HasConnectedSource() and diffuse.Get() == _BLACK)


def _input_value(shader: UsdShade.Shader, name: str) -> Any:
    """The value that arrives at an input, also through a material's interface; None without."""
    wanted = shader.GetInput(name)
    sources = wanted.GetValueProducingAttributes() if wanted else []
    return sources[0].Get() if sources else None
