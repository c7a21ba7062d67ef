"""The add-on in a real Blender: import, looks, panels, and a conversion in the background."""

import json
import shutil
import sys
import zipfile
from pathlib import Path

import pytest
from pxr import Sdf

from tests.blender import in_blender, needs_blender
from tests.scenes import make_capture
from usdbrdf.cli import main

HERE = Path(__file__).parent
# Nothing that a user types is plain ASCII.
FOLDER = "Zimmer é 椅子 (1)"


@pytest.fixture(scope="module")
def source(plugins):
    return plugins / "blender" / "usdbrdf_blender"


@pytest.fixture(scope="module")
def session(tmp_path_factory, source):
    """Run a scenario of session.py with the add-on installed among Blender's extensions."""
    resources = tmp_path_factory.mktemp("Blender é")
    installed = resources / "extensions" / "user_default" / source.name
    shutil.copytree(source, installed, ignore=shutil.ignore_patterns("__pycache__"))

    def run(scenario, *arguments):
        said = in_blender(
            HERE / "session.py",
            scenario,
            *arguments,
            folder=resources,
            timeout=900,  # the first conversion on a machine compiles its kernels
            BLENDER_USER_RESOURCES=str(resources),
        )
        report = next(x for x in said.splitlines() if x.startswith("REPORT "))
        return json.loads(report.removeprefix("REPORT "))

    return run


@pytest.fixture(scope="module")
def room(synthetic, tmp_path_factory):
    """Root layer of the small asset; nothing here changes it."""
    folder = tmp_path_factory.mktemp("room")
    built = synthetic.build(folder / FOLDER / "room", synthetic.make_scan(folder / "capture"))
    return built.asset.root_layer


@pytest.fixture(scope="module")
def told_of_looks(session, room):
    """What the scenario "looks" saw."""
    return session("looks", room)


@pytest.fixture
def program(tmp_path):
    """usdbrdf as a program of its own, as pip would install it."""
    path = tmp_path / "bin é" / "usdbrdf"
    path.parent.mkdir()
    path.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m usdbrdf "$@"\n')
    path.chmod(0o755)
    return path


def labels(seen):
    return " ".join(text for kind, text, _ in seen if kind == "label")


def alerts(seen):
    return " ".join(text for _, text, alert in seen if alert)


# Import


@needs_blender
def test_what_the_importer_loses_the_hook_keeps(session, room):
    bare = session("without_addon", room)
    kept = session("plain_import", room)
    assert not any(bare["properties"].values())
    chair = kept["properties"]["Stuhl_No_1"]
    assert chair["usdBrdf:label"] == "Stuhl Nº 1"
    assert chair["usdBrdf:fit:status"] == "measured"
    assert chair["usdBrdf:fit:phi"] == 0.25
    assert chair["usdBrdf:fit:psiError"] == 0.125
    assert chair["usdBrdf:fit:targetFrame"] == 2
    assert chair["usdBrdf:texturing:seen"] is True
    assert chair["usdBrdf:texturing:resolution"] == [4, 4]
    assert Path(chair["usdBrdf:aov:lit:file"]).is_file()
    # Unknown is absent, not a number.
    assert "usdBrdf:fit:phi" not in kept["properties"]["wall"]
    lamp = kept["properties"]["lamp"]
    assert lamp["usdBrdf:emitter:radiance"] == [8, 7, 6]
    assert lamp["usdBrdf:emitter:radianceStatus"] == "estimated"
    camera = kept["properties"]["capture"]
    assert camera["usdBrdf:capture:pinhole"] == pytest.approx([7.1, 7.1, 4.3, 2.9])
    # Materials came through either way: the lamp still shines with its measured radiance.
    for report in (bare, kept):
        lamp = report["surfaces"]["lamp"]
        assert lamp["image"] == "lamp.emission.exr"
        assert (lamp["emission_linked"], lamp["emission_strength"]) == (True, 1)
        assert {s["colorspace"] for s in report["surfaces"].values()} == {"Non-Color"}


@needs_blender
def test_a_package_brings_what_was_measured(session, room, tmp_path):
    file = tmp_path / "room é.usdz"
    assert main(["package", "-q", str(room.parent), "-o", str(file)]) == 0
    told = session("package", file)
    for kept in (told["plain"], told["properties"]):
        assert kept["Stuhl_No_1"]["usdBrdf:fit:phi"] == 0.25
        assert kept["Stuhl_No_1"]["usdBrdf:fit:status"] == "measured"
        assert kept["lamp"]["usdBrdf:emitter:radiance"] == [8, 7, 6]
        assert "usdbrdf_look" not in kept["Stuhl_No_1"]
    assert {n for n, kind in told["objects"].items() if kind == "MESH"} == {
        "Stuhl_No_1",
        "wall",
        "lamp",
    }
    assert "0.25 ± 0.031 (confidence high)" in labels(told["fit"])
    assert told["look"] is None
    assert f"{file}: a package shows one look alone" in told["no_look"]


@needs_blender
def test_looks(told_of_looks):
    told = told_of_looks
    names = {"Stuhl_No_1", "wall", "lamp"}
    assert {n: s["prim"] for n, s in told["shaded"].items()} == {
        n: f"/room/geo/{n}/mtl/{n}" for n in names
    }
    lit = told["lit"]["Stuhl_No_1"]
    assert lit["prim"] == "/room/geo/Stuhl_No_1/looks/lit"
    assert (lit["image"], lit["colorspace"]) == ("Stuhl_No_1.lit.exr", "Non-Color")
    assert (lit["emission_linked"], lit["emission_strength"]) == (True, 1)
    # Unlit: it reflects nothing.
    assert (lit["base_color"], lit["ior"]) == ([0, 0, 0], 1)
    # The map's factor from stored to shown value.
    assert told["samples"]["Stuhl_No_1"]["factor"] == 0.5
    wall = told["lit"]["wall"]
    assert wall["prim"] == "/room/geo/wall/looks/no_data"
    assert wall["emission_color"] == [0.5, 0, 0.5]
    assert told["back"] == told["shaded"]
    assert told["imported_lit"] == told["lit"]


@needs_blender
def test_a_part_of_an_object_keeps_its_own_material(session, synthetic, tmp_path):
    asset = synthetic.build(tmp_path / "room", synthetic.make_scan(tmp_path / "capture")).asset
    layer = Sdf.Layer.FindOrOpen(str(asset.edits_layer))
    part = Sdf.CreatePrimInLayer(layer, "/room/geo/Stuhl_No_1/Stuhl_No_1/seat")
    part.specifier, part.typeName = Sdf.SpecifierDef, "GeomSubset"
    for name, kind, value in (
        ("elementType", Sdf.ValueTypeNames.Token, "face"),
        ("familyName", Sdf.ValueTypeNames.Token, "materialBind"),
        ("indices", Sdf.ValueTypeNames.IntArray, [2, 3, 7]),
    ):
        Sdf.AttributeSpec(part, name, kind).default = value
    part.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
    binding = Sdf.RelationshipSpec(part, "material:binding", custom=False)
    binding.targetPathList.explicitItems = [Sdf.Path("/room/geo/wall/mtl/wall")]
    layer.Save()
    told = session("slots", asset.root_layer, "lit")
    materials, faces = told["Stuhl_No_1"]
    assert materials == ["/room/geo/Stuhl_No_1/looks/lit", "/room/geo/wall/mtl/wall"]
    assert [i for i, slot in enumerate(faces) if slot == 1] == [2, 3, 7]
    assert set(faces) == {0, 1}
    assert told["lamp"] == [["/room/geo/lamp/looks/lit"], [0] * 12]


@needs_blender
def test_a_look_shows_its_numbers_whatever_the_light(session, room, tmp_path):
    lit = session("render", room, "lit", tmp_path / "lit.exr")
    assert lit == pytest.approx([0.25] * 3, rel=1e-3)
    # The measured material is not unlit: the sun counts.
    shaded = session("render", room, "shaded", tmp_path / "shaded.exr")
    assert shaded != pytest.approx([0.25] * 3, rel=0.1)


@needs_blender
def test_switching_leaves_the_scene_as_it_was(told_of_looks):
    told = told_of_looks
    assert told["objects"] == told["objects_after"]
    assert {n for n, kind in told["objects"].items() if kind == "EMPTY"} == {
        *("room", "geo", "cameras"),
        *("Stuhl_No_1_component", "wall_component", "lamp_component"),
    }
    assert told["active"] == "Stuhl_No_1"
    assert told["selected"] == ["Stuhl_No_1"]
    # Materials of a look are imported once: three shaded, two of each map, one for "no data".
    assert told["materials"] == told["materials_after"] == 3 + 2 + 2 + 1


@needs_blender
def test_what_cannot_be_imported_is_refused(told_of_looks, room):
    told = told_of_looks
    assert "'painted' is not a look of this asset" in told["unknown"]
    assert f"{room}.txt: not an asset of usdbrdf" in told["no_asset"]
    assert "'painted' is not a look. Use one of" in told["no_look"]


# Panels


@needs_blender
def test_panels(session, room):
    told = session("panels", room)
    assert told["nothing"] == [None, None]
    chair = labels(told["Stuhl_No_1"])
    assert "MEASURED in the photographs" in chair
    assert "Material a colour under a gloss" in chair
    assert "0.25 ± 0.031 (confidence high)" in chair
    assert "0.5 ± 0.12 (confidence low)" in chair
    assert alerts(told["Stuhl_No_1"]) == ""
    wall = labels(told["wall"])
    assert "Roughness phi not known" in wall
    unseen = "UNSEEN, not measured: no photograph shows enough of the object"
    assert alerts(told["wall"]) == unseen
    assert "(8, 7, 6) ± 12%, estimated" in labels(told["lamp"])
    assert told["look"] == [["menu", "shaded", False]]
    assert {"shaded", "lit", "albedo"} <= {text for _, text, _ in told["looks"]}
    assert ["operator", "usdbrdf.convert", False] in told["convert"]
    assert told["after"] is False


def test_both_viewers_tell_the_same(plugins, source):
    """The plug-ins are installed apart, so each has a copy."""
    copy = plugins / "usdview" / "usdbrdf_usdview" / "fit_rows.py"
    assert (source / "fit_rows.py").read_bytes() == copy.read_bytes()


# Conversion


@needs_blender
def test_convert_in_the_background(session, program, tmp_path):
    scan = make_capture(tmp_path / FOLDER / "scan").folder
    output = tmp_path / FOLDER / "asset é"
    told = session("convert", program, scan, output, 0.3)
    assert told["timer"] is True
    assert told["busy"] == [False, True]
    assert labels(told["meanwhile"]).startswith("Running")
    assert ["operator", "usdbrdf.cancel", False] in told["meanwhile"]
    assert told["state"] == "done", told["line"]
    assert Path(told["asset"]).parent == output
    assert labels(told["panel"]).startswith("Done")
    assert told["idle"] == [True, False]
    # Imported at the end, with what was found.
    assert told["properties"]["box"]["usdBrdf:fit:status"] in ("measured", "undetermined")


@needs_blender
def test_a_failure_is_told_in_one_sentence(session, program, tmp_path):
    scan = tmp_path / FOLDER
    scan.mkdir()
    told = session("convert", program, scan, tmp_path / "out", 0)
    assert told["state"] == "failed"
    assert told["line"].startswith(f"{scan}: no capture of a known format")
    assert told["line"].endswith("[adapter.none]")
    assert alerts(told["panel"]).startswith("Failed")
    assert "no capture of a known format" in alerts(told["panel"])
    assert told["properties"] == {}


@needs_blender
def test_a_missing_program(session, tmp_path):
    missing = tmp_path / "no é" / "usdbrdf"
    told = session("convert", missing, tmp_path, tmp_path / "out", 0)
    assert f"{missing}: cannot be started (No such file or directory)" in told["refused"]
    assert alerts(told["panel"]).startswith("Failed")


@needs_blender
def test_cancel(session, program, tmp_path):
    scan = make_capture(tmp_path / FOLDER / "scan").folder
    # Fine enough that tracing has not ended when the texture step says it has.
    told = session("cancel", program, scan, tmp_path / "asset", 0.01)
    assert told["state"] == "cancelled"
    assert told["line"] == "terminated; the same command goes on from here."
    assert labels(told["panel"]).startswith("Cancelled")
    assert told["properties"] == {}


# The package


@needs_blender
def test_blender_builds_the_extension(source, tmp_path):
    where = "import bpy; print(bpy.utils.system_resource('SCRIPTS'))"
    scripts = in_blender("-c", where, folder=tmp_path).splitlines()[0]
    tool = Path(scripts, "addons_core", "bl_pkg", "cli", "blender_ext.py")
    folders = ("--source-dir", source, "--output-dir", tmp_path)
    in_blender(tool, "build", *folders, folder=tmp_path)
    [package] = tmp_path.glob("*.zip")
    with zipfile.ZipFile(package) as archive:
        assert {"__init__.py", "blender_manifest.toml"} <= set(archive.namelist())


@needs_blender
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_sun_is_as_strong_and_as_wide_as_the_asset_says(session, room, tmp_path, scale):
    """One that states its irradiance and one that states its radiance: Blender, too, has both."""
    layer = Sdf.Layer.CreateNew(str(tmp_path / "sun.usda"))
    layer.subLayerPaths = [str(room)]
    layer.defaultPrim = Sdf.Layer.FindOrOpen(str(room)).defaultPrim
    for prim, normalize in (("sun_a", True), ("sun_b", False)):
        sun = Sdf.CreatePrimInLayer(layer, f"/{layer.defaultPrim}/{prim}")
        sun.specifier, sun.typeName = Sdf.SpecifierDef, "DistantLight"
        for name, kind, value in (
            ("intensity", Sdf.ValueTypeNames.Float, 1.0),
            ("exposure", Sdf.ValueTypeNames.Float, 2.0),
            ("angle", Sdf.ValueTypeNames.Float, 10.0),
            ("normalize", Sdf.ValueTypeNames.Bool, normalize),
        ):
            Sdf.AttributeSpec(sun, f"inputs:{name}", kind).default = value
    layer.Save()
    of_both = [pytest.approx(4.0 * scale), pytest.approx(10.0)]
    assert session("suns", layer.realPath, str(scale)) == [[*of_both, True], [*of_both, False]]
