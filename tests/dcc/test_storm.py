"""Hydra Storm finds every texture, roughness, ior and emission of an asset that was moved."""

import shutil
from dataclasses import dataclass

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from tests.blender import needs_blender
from tests.dcc.renderers import storm
from usdbrdf.asset.layers.looks import surface
from usdbrdf.asset.layout import Asset

pytestmark = needs_blender
MOVED = "Zimmer é 椅子 (1)"
WIDTH, FOCAL = 96, 1.5  # of the picture in pixels, of the lens in widths of the picture
EYE = np.array([0.0, -8.0, 1.5])
# On the side of each object that the camera sees; the chair stands in front of the wall.
SEEN = {"Stuhl_No_1": (0.0, -0.5, 0.5), "wall": (0.8, 2.0, 1.8), "lamp": (0.0, -0.15, 2.5)}


@dataclass(frozen=True, kw_only=True)
class Shown:
    """A material without textures, of grey."""

    roughness: float
    ior: float
    diffuse: float = 0.0
    emission: float = 0.0


# What the asset says of its objects; its maps are 0.25 everywhere.
WRITTEN = {
    "Stuhl_No_1": Shown(roughness=0.5, ior=1.5, diffuse=0.25),
    "wall": Shown(roughness=1.0, ior=1.0, diffuse=0.25),
    "lamp": Shown(roughness=0.5, ior=1.5, emission=0.25),
}


def picture_of(stage, folder):
    """(WIDTH, WIDTH, 3) radiance under one light; the stage's root layer is a file, which is
    saved."""
    light = UsdLux.DistantLight.Define(stage, "/light")
    light.CreateIntensityAttr(20_000.0)
    light.AddRotateXYZOp().Set(Gf.Vec3f(80, 0, 10))
    camera = UsdGeom.Camera.Define(stage, "/camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(*EYE.tolist()))
    camera.AddRotateXOp().Set(90.0)
    camera.CreateFocalLengthAttr(FOCAL)
    camera.CreateHorizontalApertureAttr(1.0)
    camera.CreateVerticalApertureAttr(1.0)
    stage.GetRootLayer().Save()
    return storm(stage.GetRootLayer().realPath, "/camera", [1], folder, width=WIDTH)[0]


def pixels(asset, folder, *, look="shaded", instead=()):
    """Radiance (3,) of each object under one light, the look as it is or other materials instead
    of its own: {object: Shown}."""
    folder.mkdir()
    layer = Sdf.Layer.CreateNew(str(folder / "shot.usda"))
    layer.subLayerPaths = [str(asset.root_layer)]
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = stage.GetPrimAtPath(f"/{asset.name}")
    root.GetVariantSets().SetSelection("look", look)
    for name in instead:
        shown = instead[name]
        shader = surface(layer, f"/instead/{name}", roughness=shown.roughness, ior=shown.ior)
        shader.attributes["inputs:diffuseColor"].default = Gf.Vec3f(shown.diffuse)
        shader.attributes["inputs:emissiveColor"].default = Gf.Vec3f(shown.emission)
        binding = UsdShade.MaterialBindingAPI.Apply(root.GetPrimAtPath(f"geo/{name}/{name}"))
        binding.Bind(UsdShade.Material.Get(stage, f"/instead/{name}"))
    picture = picture_of(stage, folder)
    found = {}
    for name, point in SEEN.items():
        x, depth, z = point - EYE
        across, down = FOCAL * WIDTH / depth * np.array([x, -z])
        found[name] = picture[round(WIDTH / 2 + down), round(WIDTH / 2 + across)]
    return found


@pytest.fixture
def moved(built, tmp_path):
    """An asset that was made in one folder and moved to another."""
    (tmp_path / MOVED).mkdir()
    there = Asset(tmp_path / MOVED / "room", built.asset.name)
    shutil.move(built.asset.folder, there.folder)
    return there


def test_a_moved_asset_shows_what_is_written(built, request, tmp_path):
    before = pixels(built.asset, tmp_path / "before")
    moved = request.getfixturevalue("moved")
    found = pixels(moved, tmp_path / "as it is")
    expected = pixels(moved, tmp_path / "written", instead=WRITTEN)
    assert found.keys() == WRITTEN.keys()
    for name, radiance in expected.items():
        assert radiance.min() > 0.05
        assert found[name] == pytest.approx(radiance, rel=1e-3), name
        assert np.array_equal(found[name], before[name]), name


def test_the_pictures_would_tell(moved, tmp_path):
    """Other numbers, or textures that are not found, change the pixels that are compared."""
    found = pixels(moved, tmp_path / "as it is")
    rougher = {"Stuhl_No_1": Shown(roughness=0.55, ior=1.5, diffuse=0.25)}
    denser = {"Stuhl_No_1": Shown(roughness=0.5, ior=1.55, diffuse=0.25)}
    for i, other in enumerate((rougher, denser)):
        changed = pixels(moved, tmp_path / f"other {i}", instead=other)["Stuhl_No_1"]
        assert changed != pytest.approx(found["Stuhl_No_1"], rel=0.01)
    shutil.rmtree(moved.folder / "textures")
    lost = pixels(moved, tmp_path / "lost")
    for name in WRITTEN:
        assert lost[name] != pytest.approx(found[name], rel=0.01), name


@pytest.mark.parametrize("look", ["lit", "coverage", "base_color"])
def test_a_look_of_a_moved_asset_shows_its_maps(moved, tmp_path, look):
    found = pixels(moved, tmp_path / "as it is", look=look)
    unseen = (0.5, 0.0, 0.5) if look != "base_color" else (0.25,) * 3
    for name, radiance in found.items():
        expected = unseen if name == "wall" else (0.25,) * 3
        assert radiance == pytest.approx(expected, abs=1e-3), name


def test_a_component_alone_looks_as_in_the_room(moved, tmp_path):
    """By its own file, put where it stands in the room."""
    for name in SEEN:
        pictures = []
        for where in ("room", "alone"):
            folder = tmp_path / f"{name} {where}"
            folder.mkdir()
            stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
            UsdGeom.SetStageUpAxis(stage, "Z")
            UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            prim = stage.DefinePrim("/shown")
            if where == "room":
                prim.GetReferences().AddReference(str(moved.root_layer))
                for other in SEEN.keys() - {name}:
                    stage.GetPrimAtPath(f"/shown/geo/{other}").SetActive(False)
                placed = UsdGeom.Xformable(stage.GetPrimAtPath(f"/shown/geo/{name}"))
                pose = placed.GetLocalTransformation()
            else:
                prim.GetReferences().AddReference(str(moved.folder / moved.component(name)))
                UsdGeom.Xformable(prim).AddTransformOp().Set(pose)
            pictures.append(picture_of(stage, folder))
        assert (pictures[0] > 0.05).any()
        assert np.array_equal(*pictures), name
