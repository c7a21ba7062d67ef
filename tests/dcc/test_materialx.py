"""The MaterialX networks in Hydra Storm, which prefers them, look like UsdPreviewSurface."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from tests.blender import needs_blender
from tests.dcc.renderers import storm
from usdbrdf.asset.layers.task_layers import write_material_layer
from usdbrdf.files.images import write_exr

pytestmark = needs_blender


def picture(built, folder, *, materialx):
    """(H, W, 3): the chair under a distant light, which shows its lobe."""
    folder.mkdir()
    write_material_layer(
        built.asset.layer("material"), built.draft("material"),
        built.fitted, materialx=built.asset.materialx_layer if materialx else None,
    )  # fmt: skip
    layer = Sdf.Layer.CreateNew(str(folder / "shot.usda"))
    layer.subLayerPaths = [str(built.asset.root_layer)]
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, "Z")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(built.prims[0]))
    points = np.array(mesh.GetPointsAttr().Get())
    centre, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    for prim in built.prims[1:]:
        UsdGeom.Imageable(stage.GetPrimAtPath(prim)).MakeInvisible()
    light = UsdLux.DistantLight.Define(stage, "/light")
    light.CreateIntensityAttr(20_000.0)
    light.AddRotateXYZOp().Set(Gf.Vec3f(25, 20, 0))
    camera = UsdGeom.Camera.Define(stage, "/camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(*centre.tolist()) + Gf.Vec3d(0, 0, 4 * size))
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.1 * size, 10 * size))
    camera.CreateFocalLengthAttr(3.0)
    camera.CreateHorizontalApertureAttr(1.0)
    camera.CreateVerticalApertureAttr(1.0)
    layer.Save()
    return storm(layer.realPath, "/camera", [1], folder, width=96)[0]


def test_storm_shows_the_same(built, tmp_path):
    built.fitted = tuple(replace(item, mapping="matched") for item in built.fitted)
    file = f"textures/{built.fitted[0].identifier}.base_color.exr"
    rows = np.linspace(0.1, 0.6, 4, dtype=np.float32)[:, None, None]
    write_exr(built.asset.folder / file, np.broadcast_to(rows, (4, 4, 3)).copy())
    preview = picture(built, tmp_path / "preview", materialx=False)
    network = picture(built, tmp_path / "network", materialx=True)
    seen = preview.mean(axis=2) > 0.01
    assert seen.mean() > 0.1
    # Other pictures of the same, so the network is what was rendered.
    assert not np.array_equal(preview, network)
    assert network[seen].mean() == pytest.approx(preview[seen].mean(), rel=0.03)
    error = np.sqrt(((network - preview)[seen] ** 2).mean()) / preview[seen].mean()
    assert error < 0.05
