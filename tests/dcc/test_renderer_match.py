"""What Cycles and Hydra Storm reflect of the materials as we write them: directional albedo over a
grid of phi, psi and angles, against the models that the mapping was derived from and the fit."""

import itertools

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade

from tests.blender import needs_blender
from tests.dcc.renderers import cycles, storm
from usdbrdf.asset.layers.looks import surface
from usdbrdf.asset.preview_lobe import preview_surface_from_fit
from usdbrdf.transport.directional_albedo import fitted_albedo
from usdbrdf.transport.renderer_match import cycles_albedo, storm_albedo

pytestmark = needs_blender

PHI, PSI = (0.05, 0.1, 0.3, 0.6, 1.0), (0.25, 0.5, 1.0)
ANGLES = np.radians([10, 45, 75])
DIFFUSE = (0.0, 0.5)
MAPPINGS = ("measured", "matched")
# Everything that is rendered: a patch per combination, in this order.
GRID = list(itertools.product(MAPPINGS, DIFFUSE, PHI, PSI))
SHAPE = (len(MAPPINGS), len(DIFFUSE), len(PHI), len(PSI), len(ANGLES))


def new_stage(path):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/all").GetPrim())
    for number, (mapping, diffuse, phi, psi) in enumerate(GRID):
        shown = preview_surface_from_fit(phi, psi, mapping)
        shader = surface(
            stage.GetRootLayer(), f"/all/m{number}", roughness=shown.roughness, ior=shown.ior
        )
        shader.attributes["inputs:diffuseColor"].default = Gf.Vec3f(diffuse * shown.diffuse)
    return stage


def add_patches(stage, number, corners, normals=None):
    """Rectangles (P, 4, 3) of one material, with one normal (P, 3) each."""
    mesh = UsdGeom.Mesh.Define(stage, f"/all/patch{number}")
    mesh.CreatePointsAttr(corners.reshape(-1, 3).astype(np.float32))
    mesh.CreateFaceVertexCountsAttr([4] * len(corners))
    mesh.CreateFaceVertexIndicesAttr(list(range(4 * len(corners))))
    mesh.CreateSubdivisionSchemeAttr("none")
    if normals is not None:
        mesh.CreateNormalsAttr(normals.astype(np.float32))
        mesh.SetNormalsInterpolation("uniform")
    binding = UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    binding.Bind(UsdShade.Material.Get(stage, f"/all/m{number}"))


def rectangle(x, y, width, height):
    return np.array([[x, y, 0], [x + width, y, 0], [x + width, y + height, 0], [x, y + height, 0]])


@pytest.fixture(scope="module")
def in_cycles(tmp_path_factory):
    """Directional albedo (SHAPE) that Cycles renders: what white surroundings leave of a patch."""
    folder = tmp_path_factory.mktemp("cycles")
    stage, across, distance, scale = new_stage(folder / "stage.usda"), len(GRID), 2000.0, 6
    for number in range(across):
        add_patches(stage, number, rectangle(number - across / 2, -8, 1, 16)[None])
    stage.Save()
    views = []
    for angle in ANGLES:
        pose = np.eye(4)
        pose[1:3, 1:3] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = pose[:3, 2] * distance
        size = (across * scale, 2 * scale)
        optics = [scale * distance] * 2 + [size[0] / 2, size[1] / 2]
        views.append({"world_from_camera": pose.tolist(), "intrinsics": optics, "resolution": size})
    found = cycles(folder / "stage.usda", views, folder, samples=128, surroundings=1.0)
    patches = found[..., 0].reshape(len(ANGLES), 2 * scale, across, scale)[..., 1:-1]
    return patches.mean(axis=(1, 3)).T.reshape(SHAPE)


@pytest.fixture(scope="module")
def in_storm(tmp_path_factory):
    """The same of Storm, from BRDF values: sums over directions (b, a) of the light about that of
    the view, dw = sin b db da. Patches have normals all around the view (a), lights take turns (b).
    """
    folder = tmp_path_factory.mktemp("storm")
    stage, distance, pixels = new_stage(folder / "stage.usda"), 1e5, 3
    azimuths, polar, at_once = 64, 112, 8
    a = (np.arange(azimuths) + 0.5) * np.pi / azimuths  # the other half is its mirror image
    normals = [
        np.stack([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t) + 0 * a], axis=1)
        for t in ANGLES
    ]
    across = azimuths * len(ANGLES)
    for number in range(len(GRID)):
        corners = np.array([rectangle(i - across / 2, number, 1, 1) for i in range(across)])
        add_patches(stage, number, corners, np.concatenate(normals))
    step = np.pi / polar
    for k in range(at_once):
        light = UsdLux.DistantLight.Define(stage, f"/all/light{k}")
        light.CreateAngleAttr(1.0)
        turn, intensity = light.AddRotateYOp(), light.CreateIntensityAttr()
        for time in range(polar // at_once):
            b = (time * at_once + k + 0.5) * step
            turn.Set(float(np.degrees(b)), time)
            intensity.Set(float(np.sin(b) * step / (np.pi * np.sin(np.radians(0.5)) ** 2)), time)
    camera = UsdGeom.Camera.Define(stage, "/all/camera")
    camera.AddTranslateOp().Set(Gf.Vec3d(0, len(GRID) / 2, distance))
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.5 * distance, 2 * distance))
    camera.CreateFocalLengthAttr(distance)
    camera.CreateHorizontalApertureAttr(float(across))
    camera.CreateVerticalApertureAttr(float(len(GRID)))
    stage.Save()
    times = range(polar // at_once)
    found = storm(folder / "stage.usda", "/all/camera", times, folder, width=pixels * across)
    total = found[..., 0].astype(np.float64).sum(axis=0)[::-1]  # rows from the bottom
    total = total.reshape(len(GRID), pixels, len(ANGLES), azimuths, pixels)[:, 1, :, :, 1]
    return (total.sum(axis=2) * 2 * np.pi / azimuths).reshape(SHAPE)


def models(albedo, **more):
    """Lobe and share of the diffuse term (mapping, phi, psi, angle) of a renderer's model."""
    found = np.zeros((2, len(MAPPINGS), len(PHI), len(PSI), len(ANGLES)))
    for m, i, j in itertools.product(*(range(len(x)) for x in (MAPPINGS, PHI, PSI))):
        shown = preview_surface_from_fit(PHI[i], PSI[j], MAPPINGS[m])
        f0 = np.array([((shown.ior - 1) / (shown.ior + 1)) ** 2])
        one = albedo(PHI[i], f0, np.cos(ANGLES), **more)
        found[:, m, i, j] = one.lobe[:, 0], one.diffuse[:, 0] * shown.diffuse
    return found


def fitted():
    """Directional albedo (phi, psi, angle) of the fit's own lobe."""
    f0 = 0.08 * np.array(PSI)
    return np.array([fitted_albedo(phi, f0, np.cos(ANGLES)).T for phi in PHI])


@pytest.mark.parametrize(
    ("rendered", "albedo", "more"),
    [("in_cycles", cycles_albedo, {}), ("in_storm", storm_albedo, {"mirror_error": True})],
)
def test_renderers_reflect_what_their_models_say(request, rendered, albedo, more):
    found = request.getfixturevalue(rendered)
    lobe, kept = models(albedo, **more)
    np.testing.assert_allclose(found[:, 0], lobe, rtol=0.03)
    np.testing.assert_allclose(found[:, 1] - found[:, 0], 0.5 * kept, rtol=0.03)


@pytest.mark.parametrize("rendered", ["in_cycles", "in_storm"])
def test_matched_is_closer_to_the_fit(request, rendered):
    found = request.getfixturevalue(rendered)
    expected = fitted() + np.array(DIFFUSE)[:, None, None, None]
    # With a diffuse term of 0.5, from phi = 0.1 on: what Storm adds to mirrors nothing mends. The
    # lobes themselves keep their shapes, which differ at the edge.
    total = (found / expected - 1)[:, 1, 1:]
    error = np.sqrt((total**2).mean(axis=(1, 2, 3)))
    assert error[1] < 0.7 * error[0]
    assert error[1] < 0.035
