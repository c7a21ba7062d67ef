"""Rules about materials: what renderers would show otherwise than it was measured."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any

from pxr import Gf, Sdf, Usd, UsdShade

from usdbrdf.asset.preview_lobe import PreviewLobe, preview_surface_from_fit
from usdbrdf.asset.readers.scene import authored
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import Fault, Severity, Site, cure, rule

Types = Sdf.ValueTypeNames
_LINEAR_FORMATS = frozenset({".exr", ".hdr"})
_SCOPES = ("materials", "looks")
_BLACK = Gf.Vec3f(0.0)
# Of numbers that a layer holds as 32-bit floats.
_TOLERANCE = 1e-4
# Fits from before the mapping was recorded have none; of one that is not known nothing can be said.
_MEASURED = "measured"
_MAPPINGS = (_MEASURED, "matched")
_RECORD = ("usdBrdf:fit:phi", "usdBrdf:fit:psi", "usdBrdf:fit:mapping")


@cure("sourceColorSpace = raw")
def read_raw(site: Site) -> bool:
    UsdShade.Shader(site).CreateInput("sourceColorSpace", Types.Token).Set("raw")
    return True


@rule(
    Severity.ERROR,
    advice="Author inputs:sourceColorSpace = raw on the texture, or remove the opinion that says "
    "otherwise.",
    cure=read_raw,
)
def texture_color_space(scene: AssetStage) -> Iterator[Fault]:
    """Textures in OpenEXR or Radiance files hold linear values and are read as such
    (sourceColorSpace = raw). With auto or sRGB several applications decode them as sRGB, and every
    colour comes out darker."""
    for scope in _SCOPES:
        for shader in scene.shaders(scope, "UsdUVTexture"):
            file = _input_value(shader, "file")
            suffix = PurePosixPath(file.path).suffix.lower() if file else ""
            space = _input_value(shader, "sourceColorSpace") or "auto"
            if suffix in _LINEAR_FORMATS and space != "raw":
                yield Fault(
                    shader.GetPrim(),
                    f"sourceColorSpace is {space}, but @{file.path}@ holds linear values.",
                )


@cure("block inputs:specularColor")
def block(site: Site) -> bool:
    site.SetConnections([])
    site.Block()
    return True


@rule(
    Severity.ERROR,
    advice="Remove or block inputs:specularColor; or set useSpecularWorkflow to 1, if the measured "
    "reflectance is to be replaced.",
    cure=block,
)
def specular_color(scene: AssetStage) -> Iterator[Fault]:
    """Materials of ours state their reflectance by ior and have no specularColor. The specification
    ignores it while useSpecularWorkflow is 0; Blender and three.js do not, and show a highlight of
    half the strength."""
    for scope in _SCOPES:
        for shader in scene.shaders(scope, "UsdPreviewSurface"):
            colour = shader.GetInput("specularColor")
            if colour and _has_opinion(colour) and not _input_value(shader, "useSpecularWorkflow"):
                yield Fault(
                    colour.GetAttr(),
                    "specularColor is authored, but useSpecularWorkflow is 0: some "
                    "applications multiply it onto the reflectance that ior gives.",
                )


@cure("the record as measured; roughness, ior and factor that it stands for")
def show_record(site: Site) -> bool:
    """The record as it was measured, and the material as that record says."""
    scene = AssetStage(site.GetStage())
    surface = scene.surface_of(site)
    if surface is None:
        return False
    _restore_record(scene, site)
    wanted = _recorded_lobe(site)
    for shown, value in _contradictions(scene, surface, wanted) if wanted else ():
        scale = shown.GetTypeName() == Types.Float4
        shown.Set(Gf.Vec4f(value, value, value, 1.0) if scale else value)
    return True


@rule(
    Severity.ERROR,
    advice="To change how a surface looks author roughness and ior of its material; leave the "
    "record of the measurement as it is.",
    cure=show_record,
)
def lobe_matches_fit(scene: AssetStage) -> Iterator[Fault]:
    """Roughness, ior and the factor on the colour of an object's material are those that its
    recorded phi and psi stand for under the recorded mapping. Where they differ, the file
    contradicts itself: somebody edited the record, which changes no picture, or a layer of ours.
    What an artist's layer says about the material is not judged."""
    for item in scene.objects:
        wanted, surface = _recorded_lobe(item), scene.surface_of(item)
        if wanted is None or surface is None:
            continue
        for shown, value in _contradictions(scene, surface, wanted):
            yield Fault(
                item,
                f"<{shown.GetPath()}> is {_first(shown.Get()):.4g}, but by usdBrdf:fit:phi and "
                f"psi under the mapping {_mapping(item)} it is {value:.4g}.",
            )


def _recorded_lobe(item: Usd.Prim) -> PreviewLobe | None:
    """What an object's record stands for; None where it tells nothing."""
    phi, psi = (authored(item, name) for name in _RECORD[:2])
    if _mapping(item) not in _MAPPINGS or phi is None or psi is None:
        return None
    in_range = 0 <= phi <= 1 and 0 <= psi <= 1
    return preview_surface_from_fit(phi, psi, _mapping(item)) if in_range else None


def _mapping(item: Usd.Prim) -> str:
    return str(authored(item, "usdBrdf:fit:mapping") or _MEASURED)


def _contradictions(
    scene: AssetStage, surface: UsdShade.Shader, wanted: PreviewLobe
) -> Iterator[tuple[Usd.Attribute, float]]:
    """The attributes of our layers that show another lobe, and what they should be; what an artist
    changes on purpose is theirs."""
    for shown, value in _shown(surface, wanted):
        if scene.is_measured(shown) and abs(_first(shown.Get()) - value) > _TOLERANCE:
            yield shown, value


def _shown(surface: UsdShade.Shader, wanted: PreviewLobe) -> Iterator[tuple[Usd.Attribute, float]]:
    """The attributes that show a lobe, as far as they are authored, and what they should be."""
    for name, value in (("roughness", wanted.roughness), ("ior", wanted.ior)):
        shown = surface.GetInput(name)
        if shown and not shown.HasConnectedSource():
            yield shown.GetAttr(), value
    diffuse = surface.GetInput("diffuseColor")
    sources = diffuse.GetConnectedSources()[0] if diffuse else []
    scale = UsdShade.Shader(sources[0].source.GetPrim()).GetInput("scale") if sources else None
    if scale:
        yield scale.GetAttr(), wanted.diffuse


def _first(value: Any) -> float:
    """A number, or the first of the equal ones of a colour."""
    return float(value[0] if isinstance(value, Gf.Vec4f) else value)


def _restore_record(scene: AssetStage, item: Usd.Prim) -> None:
    """What others say of the measurement gives way to what our layers say, be it nothing."""
    for name in _RECORD:
        recorded = item.GetAttribute(name)
        if authored(item, name) is not None and not scene.is_measured(recorded):
            ours = scene.measured(recorded)
            if ours is None:
                recorded.Block()
            else:
                recorded.Set(ours)


@cure("diffuseColor = black")
def blacken(site: Site) -> bool:
    diffuse = UsdShade.Shader(site).CreateInput("diffuseColor", Types.Color3f)
    diffuse.GetAttr().SetConnections([])
    diffuse.Set(_BLACK)
    return True


@rule(
    Severity.ERROR,
    advice="Author diffuseColor black without a connection, or edit the emission instead.",
    cure=blacken,
)
def emitter_albedo(scene: AssetStage) -> Iterator[Fault]:
    """The emission map of an emitter is all the light that was seen to leave it. A diffuseColor
    beside it adds what the other lamps would cast on it, a second time."""
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


@rule(
    Severity.ERROR,
    advice="Remove the opinions on the materials below the scope of the looks.",
    cure=only_glow,
)
def look_material(scene: AssetStage) -> Iterator[Fault]:
    """Materials of the looks that show maps only glow: black diffuseColor, ior 1. Anything else
    mixes the light of the scene into the map that is looked at."""
    for shader in scene.shaders("looks", "UsdPreviewSurface"):
        ior = shader.GetInput("ior")
        shiny = not ior or ior.Get() is None or abs(float(ior.Get()) - 1.0) > _TOLERANCE
        if shiny or not _is_black(shader):
            what = "ior is not 1" if _is_black(shader) else "diffuseColor is not black"
            yield Fault(
                shader.GetPrim(), f"{what}: light of the scene falls into the picture of the map."
            )


def _is_black(shader: UsdShade.Shader) -> bool:
    diffuse = shader.GetInput("diffuseColor")
    return bool(diffuse and not diffuse.HasConnectedSource() and diffuse.Get() == _BLACK)


def _input_value(shader: UsdShade.Shader, name: str) -> Any:
    """The value that arrives at an input, also through a material's interface; None without."""
    wanted = shader.GetInput(name)
    sources = wanted.GetValueProducingAttributes() if wanted else []
    return sources[0].Get() if sources else None


def _has_opinion(wanted: UsdShade.Input) -> bool:
    return bool(wanted.GetAttr().HasAuthoredValue() or wanted.HasConnectedSource())


RULES = (texture_color_space, specular_color, lobe_matches_fit, emitter_albedo, look_material)
