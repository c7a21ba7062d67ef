"""The menu on a real asset, in a double of usdview."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from pxr import Usd, UsdGeom, UsdShade

from tests.plugins.usdview import fake_usdview

HERE = Path(__file__).parent
INSPECT, JUMP = "Inspect Fit of Selected Object", "Jump to Target Frame"


@pytest.fixture(scope="module")
def container(plugins):
    """The plug-in's container class, imported as usdview would."""
    fake_usdview.install()
    sys.path.insert(0, str(plugins / "usdview"))
    try:
        import usdbrdf_usdview

        yield usdbrdf_usdview.UsdBrdfContainer
    finally:
        sys.path.remove(str(plugins / "usdview"))
        for name in [n for n in sys.modules if n.startswith(("pxr.Usdviewq", "usdbrdf_usdview"))]:
            del sys.modules[name]


@pytest.fixture
def viewer(container, built):
    """usdview with the asset open; the container itself is not kept, as there."""
    api = fake_usdview.UsdviewApi()
    fake_usdview.configure([container()], api, api.qMainWindow)
    api.dataModel.stage = Usd.Stage.Open(str(built.asset.root_layer))
    fake_usdview.QMessageBox.shown.clear()
    menu = api.qMainWindow.menus["usdbrdf"]

    def select(path):
        api.dataModel.selection.setPrim(api.stage.GetPrimAtPath(path))

    return SimpleNamespace(
        api=api, menu=menu, looks=menu.menus["Look"].actions, select=select, built=built
    )


def bound_material(stage, path):
    material, _ = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(path)).ComputeBoundMaterial()
    return str(material.GetPath())


def test_libplug_finds_it(plugins, built):
    folder = plugins / "usdview"
    search = os.pathsep.join([str(folder), str(HERE)])
    done = subprocess.run(
        [sys.executable, str(HERE / "load_plugins.py"), str(built.asset.root_layer)],
        env={
            **os.environ,
            "PYTHONPATH": search,
            "PXR_PLUGINPATH_NAME": str(folder / "usdbrdf_usdview"),
        },
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    shown = json.loads(done.stdout)
    assert shown["entries"] == [INSPECT, JUMP]
    assert {"shaded", "lit", "albedo", "roughness"} <= set(shown["looks"])


# Looks


def test_a_look_goes_into_the_session_layer(viewer):
    stage, folder = viewer.api.stage, viewer.built.asset.folder
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    chair = "/room/geo/Stuhl_No_1/Stuhl_No_1"
    assert bound_material(stage, chair) == "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1"
    viewer.looks["lit"].trigger()
    assert bound_material(stage, chair) == "/room/geo/Stuhl_No_1/looks/lit"
    session = stage.GetSessionLayer().GetPrimAtPath("/room")
    assert dict(session.variantSelections) == {"look": "lit"}
    assert [layer for layer in stage.GetLayerStack() if layer.dirty] == [stage.GetSessionLayer()]
    assert stage.GetEditTarget().GetLayer() == stage.GetRootLayer()
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    assert viewer.api.said == ["room, look: lit"]


def test_the_menu_follows_the_stage(viewer):
    names = set(viewer.api.stage.GetDefaultPrim().GetVariantSet("look").GetVariantNames())
    assert {name for name, entry in viewer.looks.items() if entry.visible} == names
    other = Usd.Stage.CreateInMemory()
    prim = other.DefinePrim("/thing")
    other.SetDefaultPrim(prim)
    for look in ("lit", "painted"):
        prim.GetVariantSets().AddVariantSet("look").AddVariant(look)
    viewer.api.dataModel.stage = other
    assert [n for n, entry in viewer.looks.items() if entry.visible] == ["lit", "painted"]
    viewer.api.dataModel.stage = None
    assert not any(entry.visible for entry in viewer.looks.values())


@pytest.mark.parametrize("instanceable", [False, True])
def test_a_shot_has_the_looks_of_the_asset_that_is_selected(viewer, instanceable):
    shot = Usd.Stage.CreateInMemory()
    shot.SetDefaultPrim(shot.DefinePrim("/shot"))
    for name in ("left", "right"):
        prim = shot.DefinePrim(f"/shot/{name}", "Xform")
        prim.GetReferences().AddReference(str(viewer.built.asset.root_layer))
        prim.SetInstanceable(instanceable)
    viewer.api.dataModel.selection.setPrim(shot.GetPseudoRoot())
    viewer.api.dataModel.stage = shot
    assert not any(entry.visible for entry in viewer.looks.values())
    viewer.looks["lit"].trigger()
    assert viewer.api.said == ["Select an asset that has the look lit."]
    chairs = [f"/shot/{name}/geo/Stuhl_No_1/Stuhl_No_1" for name in ("left", "right")]
    viewer.select(chairs[1])
    assert viewer.looks["lit"].visible
    viewer.looks["lit"].trigger()
    assert viewer.api.said[-1] == "right, look: lit"
    assert [bound_material(shot, path) for path in chairs] == [
        "/shot/left/geo/Stuhl_No_1/mtl/Stuhl_No_1",
        "/shot/right/geo/Stuhl_No_1/looks/lit",
    ]
    viewer.select("/shot")
    assert not any(entry.visible for entry in viewer.looks.values())


# Fit


def test_the_fit_is_told(viewer):
    viewer.select("/room/geo/Stuhl_No_1/Stuhl_No_1")
    viewer.menu.actions[INSPECT].trigger()
    [(title, text)] = fake_usdview.QMessageBox.shown
    assert title == "usdbrdf"
    assert text.splitlines() == [
        "/room/geo/Stuhl_No_1/Stuhl_No_1",
        "Object: Stuhl Nº 1 (chair)",
        "Status: MEASURED in the photographs",
        "Material: a colour under a gloss",
        "Roughness phi: 0.25 ± 0.031 (confidence high)",
        "Specular psi: 0.5 ± 0.12 (confidence low)",
        "Evidence: 0.25 of the highlights explained",
        "Loss: 0.5 at its minimum",
        "Method: views, 12 pixels",
        "Target frame: 2 (time code 3)",
    ]


@pytest.mark.parametrize(
    ("model", "name", "told"),
    [
        ("diffuse", "model", "a colour alone: no highlight was found"),
        ("conductor", "kind", "a metal"),  # as older versions called it
        ("transparent", "model", "clear glass, which is not fitted"),
    ],
)
def test_what_is_bounded_says_by_what_and_what_the_material_is(container, model, name, told):
    from usdbrdf_usdview.fit_rows import fit_rows

    facts = {"status": "bounded", name: model, "psi": 0.1, "psiError": 0.03, "psiUpper95": 0.117}
    rows = dict(fit_rows({f"usdBrdf:fit:{fact}": value for fact, value in facts.items()}))
    assert rows["Status"].startswith("BOUNDED, not measured: highlights are weaker than usual")
    assert rows["Material"] == told
    assert rows["Specular psi"] == "0.1 ± 0.03 (confidence none), below 0.12 with 95 %"


def test_what_was_not_measured_says_so(viewer):
    viewer.select("/room/geo/wall/wall")
    viewer.menu.actions[INSPECT].trigger()
    [(_, text)] = fake_usdview.QMessageBox.shown
    assert "Status: UNSEEN, not measured" in text
    # Not the schemas' fallbacks, which are numbers.
    assert "Roughness phi: not known" in text
    assert "Material: not known" in text
    assert "Target frame: none" in text


def test_an_estimated_lamp(viewer):
    viewer.select("/room/geo/lamp/lamp")
    viewer.menu.actions[INSPECT].trigger()
    [(_, text)] = fake_usdview.QMessageBox.shown
    assert "Emits: (8, 7, 6) ± 12%, estimated from the light that it casts" in text


def test_nothing_fitted_is_selected(viewer):
    viewer.select("/room/geo")
    viewer.menu.actions[INSPECT].trigger()
    assert fake_usdview.QMessageBox.shown == [
        ("usdbrdf", "Select an object that usdbrdf has fitted.")
    ]
    viewer.menu.actions[JUMP].trigger()
    assert viewer.api.said == ["Select an object that usdbrdf has fitted."]
    assert viewer.api.cameraPrim is None


# Target frame


def test_the_target_frame_is_shown(viewer):
    viewer.select("/room/geo/Stuhl_No_1/Stuhl_No_1")
    viewer.menu.actions[JUMP].trigger()
    api = viewer.api
    assert str(api.cameraPrim.GetPath()) == "/room/cameras/capture"
    # The pose at that time code is that of the photograph that the fit names.
    pose = UsdGeom.Camera(api.cameraPrim).ComputeLocalToWorldTransform(api.frame)
    expected = viewer.built.scan.frames.world_from_camera[2, :3, 3]
    assert tuple(pose.ExtractTranslation()) == pytest.approx(expected)
    assert api.drawn == 1


def test_no_target_frame(viewer):
    viewer.select("/room/geo/wall/wall")
    viewer.menu.actions[JUMP].trigger()
    assert viewer.api.cameraPrim is None
    assert viewer.api.said == ["wall: its fit (views) names no target frame."]
