"""What UsdPreviewSurface and MaterialX are told of phi and psi, and that readers undo it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, UsdShade

from usdbrdf.asset.header import Scopes
from usdbrdf.asset.preview_lobe import fit_from_preview_surface, preview_surface_from_fit
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.render_scene import render_scene_from_file
from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.transport.brdf import DIELECTRIC, PAPER
from usdbrdf.transport.renderer_match import shown_lobe, shown_share_of_metal

CHAIR, LAMP = 0, 2


def write(built, mapping, **changes):
    built.fitted = tuple(replace(item, mapping=mapping, **changes) for item in built.fitted)
    built.write_layer("material")


def surfaces(built, overriding=None):
    """Materials as rendered, by object; ``overriding``: an artist's opinions on the chair's."""
    layer = Sdf.Layer.CreateNew(str(built.asset.folder / f"shot{id(overriding)}.usda"))
    layer.subLayerPaths = [f"./{built.asset.root_layer.name}"]
    material = Scopes.of(built.asset).material(built.fitted[CHAIR].identifier)
    for name, value in (overriding or {}).items():
        prim = Sdf.CreatePrimInLayer(layer, f"{material}/PreviewSurface")
        Sdf.AttributeSpec(prim, f"inputs:{name}", Sdf.ValueTypeNames.Float).default = value
    layer.Save()
    found = render_scene_from_file(Path(layer.realPath), lambda text: None).surfaces
    return {surface.name.split("/")[-1]: surface.material for surface in found}


def test_untouched_the_asset_is_the_same_under_both_mappings(built):
    write(built, "measured")
    measured = surfaces(built)
    write(built, "matched")
    matched = surfaces(built)
    for name, one in measured.items():
        for field in ("diffuse", "f0", "roughness", "emission"):
            np.testing.assert_allclose(
                getattr(matched[name], field), getattr(one, field), rtol=1e-5, err_msg=name
            )
    layer = Sdf.Layer.OpenAsAnonymous(str(built.asset.layer("material")))
    material = Scopes.of(built.asset).material(built.fitted[CHAIR].identifier)
    assert layer.GetAttributeAtPath(
        f"{material}/PreviewSurface.inputs:ior"
    ).default != pytest.approx(1.5, abs=0.01)


def test_an_artists_opinion_counts(built):
    write(built, "matched")
    chair = built.fitted[CHAIR].identifier
    ours, theirs = surfaces(built), surfaces(built, {"roughness": 0.8, "ior": 1.7})
    # What they see in a renderer, as the fitted lobe shows it.
    assert theirs[chair].roughness == pytest.approx(0.8)
    shown = ((1.7 - 1) / (1.7 + 1)) ** 2
    psi = float(theirs[chair].f0.flat[0]) / 0.08
    assert float(shown_lobe(0.64, psi).f0) == pytest.approx(shown, rel=1e-4)
    assert psi > float(ours[chair].f0.flat[0]) / 0.08
    # And what they see of a metal.
    metal = surfaces(built, {"metallic": 1.0})[chair]
    assert metal.metallic is not None
    factor = preview_surface_from_fit(0.25, 0.5, "matched").diffuse
    shown = shown_share_of_metal(0.25)
    assert metal.base == pytest.approx(0.25 * factor / shown, rel=1e-3)


def test_the_mapping_is_recorded_where_there_is_a_lobe(built):
    write(built, "matched")
    stage = open_measured(built.asset)
    assert [read_fit(stage, prim).mapping for prim in built.prims] == [
        "matched", "measured", "matched"
    ]  # fmt: skip
    assert (
        not stage.GetPrimAtPath(built.prims[1])
        .GetAttribute("usdBrdf:fit:mapping")
        .HasAuthoredValue()
    )


def test_the_factor_is_on_the_colour_that_is_shown(built):
    chair, wall, lamp = (Scopes.of(built.asset).material(x.identifier) for x in built.fitted)
    write(built, "matched")
    factor = preview_surface_from_fit(0.25, 0.5, "matched").diffuse
    scale = Sdf.ValueTypeNames.Float4.type.pythonClass(factor, factor, factor, 1)
    layer = Sdf.Layer.OpenAsAnonymous(str(built.asset.layer("material")))
    assert layer.GetAttributeAtPath(f"{chair}/BaseColorTexture.inputs:scale").default == scale
    assert not layer.GetAttributeAtPath(f"{wall}/BaseColorTexture.inputs:scale")
    # A lamp has no colour that could be scaled; no stray prims for it.
    assert not layer.GetPrimAtPath(f"{lamp}/AlbedoTexture")
    # Methods that refine no colour leave the albedo to be scaled.
    write(built, "matched", aovs=())
    layer = Sdf.Layer.OpenAsAnonymous(str(built.asset.layer("material")))
    assert layer.GetAttributeAtPath(f"{chair}/AlbedoTexture.inputs:scale").default == scale
    write(built, "measured", aovs=())
    layer = Sdf.Layer.OpenAsAnonymous(str(built.asset.layer("material")))
    assert not layer.GetAttributeAtPath(f"{chair}/AlbedoTexture.inputs:scale")


def test_the_inverse_of_what_is_written():
    for phi, psi in ((0.001, 0.0), (0.05, 0.3), (0.64, 1.0)):
        shown = preview_surface_from_fit(phi, psi, "matched")
        fitted = fit_from_preview_surface(shown.roughness, shown.ior)
        literal = preview_surface_from_fit(phi, psi)
        assert fitted.ior == pytest.approx(literal.ior, abs=1e-6)
        assert fitted.diffuse == pytest.approx(shown.diffuse)


def test_materialx_is_told_the_same(built):
    from usdbrdf.asset.layers.task_layers import write_material_layer

    built.fitted = tuple(replace(item, mapping="matched") for item in built.fitted)
    write_material_layer(
        built.asset.layer("material"),
        built.draft("material"),
        built.fitted,
        materialx=built.asset.materialx_layer,
    )
    stage = open_measured(built.asset)
    chair, wall, lamp = (Scopes.of(built.asset).material(x.identifier) for x in built.fitted)
    shown = preview_surface_from_fit(0.25, 0.5, "matched")
    network = stage.GetPrimAtPath(f"{chair}/OpenPBR")
    assert network.GetAttribute("inputs:specular_ior").Get() == pytest.approx(shown.ior)
    assert network.GetAttribute("inputs:specular_roughness").Get() == pytest.approx(0.5)
    factor = stage.GetPrimAtPath(f"{chair}/MtlxScaled").GetAttribute("inputs:in2").Get()
    assert factor == pytest.approx(shown.diffuse)
    file = stage.GetPrimAtPath(f"{chair}/MtlxBaseColor").GetAttribute("inputs:file").Get()
    assert file.path == f"../textures/{built.fitted[0].identifier}.base_color.exr"
    assert file.resolvedPath
    # What glows, and what has no lobe, keeps its UsdPreviewSurface alone.
    for name in (wall, lamp):
        assert not stage.GetPrimAtPath(f"{name}/OpenPBR")
    built.write_layer("material")
    assert not open_measured(built.asset).GetPrimAtPath(f"{chair}/OpenPBR")


@pytest.mark.parametrize("mapping", ["measured", "matched", "microfacet"])
def test_a_metal_is_told_by_its_colour_alone(built, mapping):
    f0 = (0.75, 0.5, 0.25)
    chair, *others = built.fitted
    built.fitted = (replace(chair, model="conductor", f0=f0, psi=1.0, f0_error=0.01), *others)
    write(built, mapping)
    assert read_fit(open_measured(built.asset), chair.prim_path).psi_of_channels == pytest.approx(
        tuple(value / 0.08 for value in f0)
    )
    stage = open_measured(built.asset)
    material = UsdShade.Material.Get(stage, Scopes.of(built.asset).material(chair.identifier))
    surface = material.ComputeSurfaceSource()[0]
    colour = surface.GetInput("diffuseColor")
    assert not colour.HasConnectedSource()  # the texture beneath is taken off
    share = shown_share_of_metal(0.25) if mapping == "matched" else 1.0
    assert tuple(colour.Get()) == pytest.approx(tuple(share * value for value in f0), rel=1e-5)
    assert surface.GetInput("metallic").Get() == 1
    # And read back it is the metal that was fitted, by the equations that it was fitted with.
    rendered = surfaces(built)[chair.identifier]
    np.testing.assert_allclose(rendered.f0.reshape(-1, 3)[0], f0, rtol=1e-4)
    assert not rendered.diffuse.any()
    assert rendered.lobe == (mapping == "microfacet")


def test_the_lobe_of_renderers_needs_another_factor_only(built):
    write(built, "microfacet", lobe="microfacet")
    chair = built.fitted[CHAIR]
    told = preview_surface_from_fit(chair.phi, chair.psi, "microfacet")
    assert ((told.ior - 1) / (told.ior + 1)) ** 2 == pytest.approx(0.08 * chair.psi)
    assert 1 < told.diffuse < 1.1
    rendered = surfaces(built)[chair.identifier]
    np.testing.assert_allclose(rendered.f0, 0.08 * chair.psi, rtol=1e-4)
    np.testing.assert_allclose(rendered.diffuse, 0.25, rtol=1e-3)


@pytest.mark.parametrize("mapping", ["measured", "microfacet"])
def test_relight_takes_the_lobe_that_was_fitted(built, mapping):
    write(built, mapping, lobe="microfacet")
    chair = built.fitted[CHAIR].identifier
    assert surfaces(built)[chair].lobe == DIELECTRIC
    write(built, "measured", lobe="paper")
    assert surfaces(built)[chair].lobe == PAPER
