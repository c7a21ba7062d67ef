"""Edits made in files that are ours: kept beside edits.usda, never mixed into it."""

import os
import resource
import signal

import pytest
from pxr import Sdf, Usd, UsdShade

from usdbrdf.asset.adopt import adopt, is_damaged
from usdbrdf.asset.layout import ROLES
from usdbrdf.errors import EnvironmentFailure, OwnershipConflict


def edit(path, change):
    layer = Sdf.Layer.FindOrOpen(str(path))
    change(layer)
    layer.Save()
    return path


def set_roughness(layer):
    path = "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/PreviewSurface.inputs:roughness"
    layer.GetAttributeAtPath(path).default = 0.75


def test_an_edited_layer_wins_once_the_artist_adds_it(built):
    path = edit(built.asset.layer("material"), set_roughness)
    edits_before = built.asset.edits_layer.read_bytes()
    (adopted,) = adopt(built.asset, [path])
    assert adopted == built.asset.folder / "adopted-1.usda"
    assert built.asset.edits_layer.read_bytes() == edits_before
    assert adopted.read_bytes().startswith(b"#usda")

    built.write_layer("material")
    edit(built.asset.edits_layer, lambda layer: layer.subLayerPaths.append(f"./{adopted.name}"))
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    stage.Reload()
    surface = UsdShade.Shader.Get(stage, "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/PreviewSurface")
    assert surface.GetInput("roughness").Get() == 0.75


@pytest.mark.parametrize("role", ROLES)
def test_the_paths_of_an_adopted_layer_lead_to_the_same_files(built, role):
    (adopted,) = adopt(built.asset, [built.asset.layer(role)])
    layer = Sdf.Layer.FindOrOpen(str(adopted))
    assert not [path for path in layer.subLayerPaths if "uv" in path]
    paths = [p for p in layer.GetExternalReferences() if p] + list(
        layer.GetCompositionAssetDependencies()
    )
    stage = Usd.Stage.Open(layer)
    assert not stage.GetCompositionErrors()
    for prim in stage.TraverseAll():
        for attribute in prim.GetAttributes():
            value = attribute.Get()
            if isinstance(value, Sdf.AssetPath) and value.path:
                assert value.path.startswith(("./", "../capture", "../../capture"))
                assert value.resolvedPath, value
    assert not [p for p in paths if p.startswith("/")]


def test_an_edited_texture_is_copied_and_the_adopted_layer_points_to_the_copy(built):
    texture = built.asset.folder / "textures" / "lamp.emission.exr"
    texture.write_bytes(texture.read_bytes() + b"painted")
    layer = edit(built.asset.layer("shading"), lambda layer: None)
    adopted, copy = adopt(built.asset, [texture, layer])
    assert copy == built.asset.folder / "adopted-1" / "textures" / "lamp.emission.exr"
    assert copy.read_bytes() == texture.read_bytes()
    assert adopted == built.asset.folder / "adopted-2.usda"
    text = adopted.read_text()
    assert "@./adopted-1/textures/lamp.emission.exr@" in text
    assert "@./textures/lamp.irradiance.exr@" in text


def test_what_was_adopted_before_stays(built):
    layer = built.asset.layer("material")
    (first,) = adopt(built.asset, [layer])
    before = first.read_bytes()
    (second,) = adopt(built.asset, [layer])
    assert (first.name, second.name) == ("adopted-1.usda", "adopted-2.usda")
    assert first.read_bytes() == before


def test_a_layer_that_cannot_be_read_is_named(built):
    built.asset.layer("material").write_text("#usda 1.0\nnonsense {")
    with pytest.raises(OwnershipConflict, match=r"material\.usda.+\[ownership\.unreadable\]"):
        adopt(built.asset, [built.asset.layer("material")])
    assert not list(built.asset.folder.glob("adopted*"))


def test_a_binary_layer_is_damaged_where_usd_cannot_read_it_and_only_there(tmp_path):
    path = tmp_path / "scan.usdc"
    layer = Sdf.Layer.CreateAnonymous(".usdc")
    prim = Sdf.CreatePrimInLayer(layer, "/room")
    prim.referenceList.Prepend(Sdf.Reference("./gone.usda", "/room"))
    prim.customData = {"long": "x" * 1000}
    layer.Export(str(path))
    assert not is_damaged(path)
    path.write_bytes(path.read_bytes()[:-100])
    assert is_damaged(path)
    path.with_suffix(".usda").write_text("#usda 1.0\nnot finished {")
    assert not is_damaged(path.with_suffix(".usda"))


@pytest.mark.fault("R1")
def test_what_is_adopted_is_on_the_disk_before_anything_is_replaced(built, monkeypatch):
    asset, flushed, fsync = built.asset, set(), os.fsync

    def flushing(descriptor):
        flushed.add(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", flushing)
    layer, texture = asset.layer("material"), asset.folder / "textures" / "lamp.emission.exr"
    for copy in adopt(asset, [layer, texture]):
        above = [folder for folder in copy.parents if folder.is_relative_to(asset.folder)]
        assert {place.stat().st_ino for place in (copy, *above)} <= flushed


@pytest.mark.fault("R1")
def test_a_disk_that_takes_no_copy_is_said_and_no_half_of_one_stays(built):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
        with pytest.raises(EnvironmentFailure, match=r"adopted-1.usda: .+\[environment\.io\]$"):
            adopt(built.asset, [built.asset.layer("material")])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)
    assert not list(built.asset.folder.glob("*adopted*"))
    assert not list(built.asset.folder.glob(".tmp-*"))
