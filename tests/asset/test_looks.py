"""Every look, composed: what each object is bound to, and what that material shows."""

from dataclasses import replace

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdbrdf.asset.layout import ROLES
from usdbrdf.errors import UsdBrdfError

GREY = ("spread", "coverage", "samples", "stderr")
AOV_LOOKS = ("lit", "mean", "spread", "coverage", "samples", "irradiance", "stderr", "albedo")
REFINED = ("diffuse", "base_color")
LOOKS = {
    "scan": set(),
    "texturing": {"lit", "mean", "spread", "coverage", "samples"},
    "shading": {*AOV_LOOKS, "shaded"},
    "material": {*AOV_LOOKS, *REFINED, "shaded", "roughness", "specular"},
}
SELECTED = {"texturing": "lit", "shading": "shaded", "material": "shaded"}


def bound(stage, prim_path):
    prim = stage.GetPrimAtPath(prim_path)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    return material


def surface_of(material):
    shader, _, _ = material.ComputeSurfaceSource()
    assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
    return shader


def source_of(shader, name):
    """The texture's shader that feeds an input, or None."""
    sources, _ = shader.GetInput(name).GetConnectedSources()
    return UsdShade.Shader(sources[0].source.GetPrim()) if sources else None


def select(stage, look):
    stage.SetEditTarget(stage.GetSessionLayer())
    stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection(look)


@pytest.mark.parametrize("upto", ROLES)
def test_the_looks_after_every_stage(tmp_path, synthetic, upto):
    scan = synthetic.make_scan(tmp_path / "capture")
    built = synthetic.build(tmp_path / "room", scan, upto=upto)
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    root = stage.GetDefaultPrim()
    assert set(root.GetVariantSet("look").GetVariantNames()) == LOOKS[upto]
    assert root.GetVariantSet("look").GetVariantSelection() == SELECTED.get(upto, "")


@pytest.mark.parametrize("look", sorted(LOOKS["material"]))
def test_every_object_is_bound_in_every_look(built, look):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    select(stage, look)
    for prim_path, identifier in zip(built.prims, ("Stuhl_No_1", "wall", "lamp"), strict=True):
        material = bound(stage, prim_path)
        assert material, f"<{prim_path}> has no material in the look {look}"
        if look == "shaded":
            expected = f"/room/geo/{identifier}/mtl/{identifier}"
        elif material.GetPath().name == "no_data":
            expected = f"/room/geo/{identifier}/looks/no_data"
        else:
            expected = f"/room/geo/{identifier}/looks/{look}"
        assert material.GetPath() == expected
        for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
            api = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(prim_path))
            assert api.ComputeBoundMaterial(purpose)[0].GetPath() == expected


@pytest.mark.parametrize("look", AOV_LOOKS + REFINED)
def test_a_map_is_shown_unlit_and_raw(built, look):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    select(stage, look)
    shader = surface_of(bound(stage, built.prims[0]))
    assert shader.GetInput("diffuseColor").Get() == (0, 0, 0)
    assert shader.GetInput("ior").Get() == 1
    assert shader.GetInput("roughness").Get() == 1
    texture = source_of(shader, "emissiveColor")
    file = texture.GetInput("file").Get()
    assert file.path == f"../textures/Stuhl_No_1.{look}.exr"
    assert file.resolvedPath
    assert texture.GetInput("sourceColorSpace").Get() == "raw"
    assert {texture.GetInput(name).Get() for name in ("wrapS", "wrapT")} == {"clamp"}
    reader = source_of(texture, "st")
    assert reader.GetInput("varname").Get() == "st"
    scale = texture.GetInput("scale")
    assert (scale.Get() if scale else None) == ((0.5, 0.5, 0.5, 1) if look == "samples" else None)


@pytest.mark.parametrize("look", ["lit", "coverage", "roughness"])
def test_what_is_not_known_is_not_black(built, look):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    select(stage, look)
    shader = surface_of(bound(stage, "/room/geo/wall/wall"))
    assert source_of(shader, "emissiveColor") is None
    assert shader.GetInput("emissiveColor").Get() == (0.5, 0, 0.5)


def test_the_fitted_parameters_show_as_greys(built):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    for look, value in (("roughness", 0.25), ("specular", 0.5)):
        select(stage, look)
        shader = surface_of(bound(stage, built.prims[0]))
        assert shader.GetInput("emissiveColor").Get() == (value,) * 3


def test_the_shaded_material_of_a_reflector(built):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    shader = surface_of(bound(stage, built.prims[0]))
    # The colour without specular light is stronger than the albedo.
    colour = source_of(shader, "diffuseColor")
    assert colour.GetInput("file").Get().path == "../textures/Stuhl_No_1.base_color.exr"
    assert colour.GetInput("fallback").Get() == (0.25, 0.125, 0.0625, 1)
    assert shader.GetInput("emissiveColor").Get() == (0, 0, 0)
    assert shader.GetInput("roughness").Get() == pytest.approx(0.5)
    assert shader.GetInput("ior").Get() == pytest.approx(1.5)
    assert shader.GetInput("metallic").Get() == 0
    assert shader.GetInput("useSpecularWorkflow").Get() == 0
    assert not shader.GetInput("specularColor")


def test_without_materials_objects_show_their_mean_colour(built):
    """The wall has no refined colour of its own here, and the lamp has its hue."""
    built.fitted = (
        built.fitted[0],
        replace(built.fitted[1], mean_color=(0, 0, 0)),
        built.fitted[2],
    )
    built.write_layer("material")
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    shown = [UsdGeom.Gprim.Get(stage, path).GetDisplayColorPrimvar() for path in built.prims]
    assert {primvar.GetInterpolation() for primvar in shown} == {"constant"}
    expected = [(0.25, 0.125, 0.0625), (0.5, 0.25, 0.125), (1, 0.875, 0.75)]
    assert [tuple(primvar.Get()[0]) for primvar in shown] == expected


def test_without_a_refined_colour_the_material_reads_the_albedo(built):
    built.fitted = tuple(replace(item, aovs=()) for item in built.fitted)
    built.write_layer("material")
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    albedo = source_of(surface_of(bound(stage, built.prims[0])), "diffuseColor")
    assert albedo.GetInput("file").Get().path == "../textures/Stuhl_No_1.albedo.exr"
    assert albedo.GetInput("fallback").Get() == (0.5, 0.25, 0.125, 1)


def test_the_shaded_material_of_an_emitter(built):
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    shader = surface_of(bound(stage, "/room/geo/lamp/lamp"))
    assert shader.GetInput("diffuseColor").Get() == (0, 0, 0)
    assert source_of(shader, "diffuseColor") is None
    emission = source_of(shader, "emissiveColor")
    assert emission.GetInput("file").Get().path == "../textures/lamp.emission.exr"
    assert shader.GetInput("roughness").GetAttr().HasAuthoredValue()
    assert shader.GetInput("ior").GetAttr().HasAuthoredValue()


def test_an_object_that_glows_in_places_reflects_as_well(built):
    wall, lamp = built.shaded[1], built.shaded[2]
    both = replace(wall, aovs=(*wall.aovs, *(a for a in lamp.aovs if a.name == "emission")))
    built.shaded = (built.shaded[0], both, lamp)
    built.write_layer("shading")
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    shader = surface_of(bound(stage, wall.prim_path))
    assert source_of(shader, "diffuseColor").GetPath().name == "BaseColorTexture"
    assert source_of(shader, "emissiveColor").GetPath().name == "EmissionTexture"


def test_a_map_that_is_missing_is_our_own_mistake(built):
    built.shaded = (replace(built.shaded[0], aovs=()), *built.shaded[1:])
    with pytest.raises(UsdBrdfError, match=r"no albedo map.+\[stage\.aov\]"):
        built.write_layer("shading")


def test_without_a_fit_there_is_no_lobe(built):
    """The wall was not seen: its material stays diffuse, as the shading layer wrote it."""
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    shader = surface_of(bound(stage, "/room/geo/wall/wall"))
    assert shader.GetInput("ior").Get() == 1
    assert shader.GetInput("roughness").Get() == 1


def test_bindings_are_authored_inside_the_variants_only(built):
    for role in ROLES:
        layer = Sdf.Layer.FindOrOpen(str(built.asset.layer(role)))
        outside = []
        layer.Traverse(
            "/",
            lambda path, found=outside: (
                found.append(path)
                if path.name.startswith("material:binding")
                and not path.ContainsPrimVariantSelection()
                else None
            ),
        )
        assert outside == []


def test_what_the_artist_overrides_survives_all_stages_run_again(built):
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    stage.SetEditTarget(edits)
    surface = UsdShade.Shader.Get(stage, "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/PreviewSurface")
    surface.GetInput("roughness").Set(0.125)
    own = UsdShade.Material.Define(stage, "/room/mtl/mine")
    UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath("/room/geo/wall/wall")).Bind(own)
    stage.GetDefaultPrim().GetVariantSet("look").SetVariantSelection("albedo")
    edits.Save()
    before = built.asset.edits_layer.read_bytes()

    for role in ROLES:
        built.write_layer(role)

    assert built.asset.edits_layer.read_bytes() == before
    fresh = Usd.Stage.Open(str(built.asset.root_layer))
    fresh.Reload()
    assert fresh.GetDefaultPrim().GetVariantSet("look").GetVariantSelection() == "albedo"
    assert bound(fresh, "/room/geo/wall/wall").GetPath() == "/room/mtl/mine"
    select(fresh, "shaded")
    shader = surface_of(bound(fresh, built.prims[0]))
    assert shader.GetInput("roughness").Get() == 0.125
    assert shader.GetInput("ior").Get() == pytest.approx(1.5)


def materials_in(stage):
    prims = stage.TraverseAll()
    return {str(p.GetPath()) for p in prims if p.GetTypeName() == "Material" and p.IsDefined()}


@pytest.mark.parametrize("look", sorted(LOOKS["material"]))
def test_only_what_is_worn_is_composed(built, look):
    """Beside the measured materials, which an artist's look may bind."""
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    select(stage, look)
    worn = {str(bound(stage, path).GetPath()) for path in built.prims}
    identifiers = ("Stuhl_No_1", "wall", "lamp")
    assert materials_in(stage) == worn | {f"/room/geo/{i}/mtl/{i}" for i in identifiers}


def test_what_is_said_of_a_look_holds_in_it_and_defines_nothing_in_others(built):
    """At the path that it has always had; also of an artist's look with a measured material."""
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    shader = Sdf.CreatePrimInLayer(edits, "/room/geo/Stuhl_No_1/looks/lit/AovTexture")
    scale = Sdf.AttributeSpec(shader, "inputs:scale", Sdf.ValueTypeNames.Float4)
    scale.default = (2, 2, 2, 1)
    mine = Sdf.CreatePrimInLayer(edits, "/room{look=mine}geo/lamp/lamp")
    binding = Sdf.RelationshipSpec(mine, "material:binding", custom=False)
    binding.targetPathList.explicitItems = [Sdf.Path("/room/geo/wall/mtl/wall")]
    edits.Save()
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    assert "/room/geo/Stuhl_No_1/looks/lit" not in materials_in(stage)
    assert not stage.GetPrimAtPath("/room/geo/Stuhl_No_1/looks/lit").IsDefined()
    select(stage, "lit")
    texture = source_of(surface_of(bound(stage, built.prims[0])), "emissiveColor")
    assert texture.GetInput("scale").Get() == (2, 2, 2, 1)
    select(stage, "mine")
    assert bound(stage, built.prims[2]).GetPath() == "/room/geo/wall/mtl/wall"


def test_a_look_stands_in_its_variant_alone_in_every_layer(built):
    """Targets are told as they are in the stage."""
    places, targets = [], []
    for role in ROLES:
        layer = Sdf.Layer.FindOrOpen(str(built.asset.layer(role)))

        def visit(path, layer=layer):
            spec = layer.GetObjectAtPath(path)
            if isinstance(spec, Sdf.PrimSpec) and path.name == "looks":
                places.append(path)
            if isinstance(spec, Sdf.AttributeSpec):
                targets.extend(spec.connectionPathList.explicitItems)

        layer.Traverse("/", visit)
    assert places
    assert all(path.ContainsPrimVariantSelection() for path in places)
    assert targets
    assert not any(path.ContainsPrimVariantSelection() for path in targets)
