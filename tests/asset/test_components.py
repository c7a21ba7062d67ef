"""The asset in a pipeline: payload, objects that stand alone, pivots, and a folder that moves."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils

from tests.scenes import make_capture
from tests.validation.faults import edited
from usdbrdf.asset.header import Provenance, new_layer, refuse_old_layout
from usdbrdf.asset.layers import interface
from usdbrdf.asset.layers.interface import components_of, write_interface
from usdbrdf.asset.layers.task_layers import write_material_layer
from usdbrdf.asset.layout import ROLES
from usdbrdf.asset.readers.compose import open_edited, open_measured, open_weaker
from usdbrdf.asset.readers.scene import frames_from_stage, scene_from_stage
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.model.mesh import ObjectLabel
from usdbrdf.tasks.task import Task
from usdbrdf.validation.validate import validate

IDENTIFIERS = ("Stuhl_No_1", "wall", "lamp")


def opened(asset, load=Usd.Stage.LoadAll):
    stage = Usd.Stage.Open(str(asset.root_layer), load)
    assert not stage.GetCompositionErrors()
    return stage


def box_of(prim, *, hints=True):
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"], useExtentsHint=hints)
    return np.array([*cache.ComputeWorldBound(prim).ComputeAlignedRange().GetMin()]), np.array(
        [*cache.ComputeWorldBound(prim).ComputeAlignedRange().GetMax()]
    )


def test_without_payloads_there_are_boxes_and_choices_alone(built):
    light, full = opened(built.asset, Usd.Stage.LoadNone), opened(built.asset)
    root = light.GetDefaultPrim()
    assert not root.IsLoaded()
    assert len(list(light.TraverseAll())) == 2 + len(IDENTIFIERS)
    assert not [prim for prim in light.TraverseAll() if prim.IsA(UsdGeom.Mesh)]
    for name in ("look", "lights"):
        there, here = (stage.GetDefaultPrim().GetVariantSet(name) for stage in (full, light))
        assert len(here.GetVariantNames()) > 1
        assert here.GetVariantNames() == there.GetVariantNames()
        assert here.GetVariantSelection() == there.GetVariantSelection() != ""
    paths = ("/room", *(f"/room/geo/{name}" for name in IDENTIFIERS))
    for path in paths:
        boxes = box_of(light.GetPrimAtPath(path)), box_of(full.GetPrimAtPath(path), hints=False)
        np.testing.assert_allclose(boxes[0], boxes[1], atol=1e-6)
    root.Load()
    assert UsdGeom.Mesh.Get(light, built.prims[0])


@pytest.mark.parametrize("networks", [False, True])
def test_what_the_payload_opens_is_told_before_it_is_loaded(built, networks):
    asset = built.asset
    if networks:
        layer, draft = asset.layer("material"), built.draft("material")
        write_material_layer(layer, draft, built.fitted, materialx=asset.materialx_layer)
        write_interface(asset.interface("material"), layer)
    light, full = opened(asset, Usd.Stage.LoadNone), opened(asset)
    used = [{each.realPath for each in stage.GetUsedLayers()} for stage in (light, full)]
    info = light.GetDefaultPrim().GetAssetInfo()
    told = {path.resolvedPath for path in info["payloadAssetDependencies"]}
    assert told == {path for path in used[1] - used[0] if path}
    assert (str(asset.materialx_layer) in told) == networks
    assert info["version"] == "work"
    assert {"previews", "identifier"} <= {*info}


@pytest.mark.parametrize("upto", ROLES)
def test_what_can_be_chosen_is_known_after_every_stage(tmp_path, synthetic, upto):
    scan = synthetic.make_scan(tmp_path / "capture")
    asset = synthetic.build(tmp_path / "room", scan, upto=upto).asset
    stages = (opened(asset), opened(asset, Usd.Stage.LoadNone))
    names = [stage.GetDefaultPrim().GetVariantSet("look").GetVariantNames() for stage in stages]
    assert names[0] == names[1]
    assert bool(names[0]) == (upto != "scan")


def worn(stage, mesh):
    """What a renderer is told of a mesh, by names within its component."""
    prim = stage.GetPrimAtPath(mesh)
    above = prim.GetParent().GetPath()
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    told = {}
    for node in Usd.PrimRange(material.GetPrim()):
        for attribute in node.GetAuthoredAttributes():
            sources = [str(path.MakeRelativePath(above)) for path in attribute.GetConnections()]
            value = attribute.Get()
            value = value.resolvedPath if isinstance(value, Sdf.AssetPath) else value
            told[str(attribute.GetPath().MakeRelativePath(above))] = value, sources
    return told


def values(prim):
    return {
        each.GetName(): each.Get()
        for each in prim.GetAuthoredAttributes()
        if not isinstance(each.Get(), Sdf.AssetPath)
    }


@pytest.mark.parametrize("alone", ["its file", "its path"])
def test_a_component_alone_is_what_it_is_in_the_room(built, tmp_path, alone):
    room = opened(built.asset)
    for name, mesh in zip(IDENTIFIERS, built.prims, strict=True):
        layer = Sdf.Layer.CreateNew(str(tmp_path / f"{name}.usda"))
        prim = Sdf.CreatePrimInLayer(layer, "/prop")
        prim.specifier = Sdf.SpecifierDef
        file = Sdf.Reference(str(built.asset.folder / built.asset.component(name)))
        path = Sdf.Reference(str(built.asset.root_layer), f"/room/geo/{name}")
        prim.referenceList.prependedItems = [file if alone == "its file" else path]
        stage = Usd.Stage.Open(layer)
        assert not stage.GetCompositionErrors()
        root, there = stage.GetPrimAtPath("/prop"), room.GetPrimAtPath(f"/room/geo/{name}")
        assert Usd.ModelAPI(root).GetKind() == "component"
        assert worn(stage, f"/prop/{name}") == worn(room, mesh)
        assert values(stage.GetPrimAtPath(f"/prop/{name}")) == values(room.GetPrimAtPath(mesh))
        pose = UsdGeom.Xformable(root).GetLocalTransformation()
        placed = UsdGeom.Xformable(there).GetLocalTransformation()
        assert pose == (Gf.Matrix4d(1) if alone == "its file" else placed)


def test_a_components_file_has_a_payload_of_its_own(built):
    for name in IDENTIFIERS:
        file = built.asset.folder / built.asset.component(name)
        stage = Usd.Stage.Open(str(file), Usd.Stage.LoadNone)
        root = stage.GetDefaultPrim()
        assert root.GetName() == name
        assert not root.GetChildren()
        low, high = box_of(root)
        assert np.linalg.norm(high - low) > 0.1
        root.Load()
        assert UsdGeom.Mesh(root.GetChild(name)).GetPointsAttr().Get()


def test_what_the_artist_says_holds_for_the_component_too(built):
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    stage = opened(built.asset)
    stage.SetEditTarget(edits)
    surface = UsdShade.Shader.Get(stage, "/room/geo/lamp/mtl/lamp/PreviewSurface")
    surface.GetInput("roughness").Set(0.75)
    edits.Save()
    alone = Usd.Stage.Open(str(built.asset.folder / built.asset.component("lamp")))
    shader = UsdShade.Shader.Get(alone, "/lamp/mtl/lamp/PreviewSurface")
    assert shader.GetInput("roughness").Get() == 0.75


@pytest.mark.parametrize(("unit", "up_axis"), [(1.0, "Z"), (0.01, "Y")])
def test_pivots_are_in_the_middle_of_the_lower_side(tmp_path, synthetic, unit, up_axis):
    scan = synthetic.make_scan(tmp_path / "capture", unit=unit, up_axis=up_axis)
    up = "XYZ".index(up_axis)
    for item in components_of(scan):
        low, high = item.extent
        across = np.delete((low + high) / 2, up)
        assert np.abs(across).max() < 1e-3
        assert abs(low[up]) < 1e-3
    built = synthetic.build(tmp_path / "room", scan, upto="scan")
    scene = scene_from_stage(open_weaker(built.asset, "texturing"))
    order = np.argsort(scan.mesh.face_object, kind="stable")
    expected = scan.mesh.points[scan.mesh.triangles[order]] * unit
    np.testing.assert_allclose(scene.points[scene.triangles], expected, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(scene.corner_normals, scan.mesh.corner_normals[order])


def test_a_board_on_a_sheet_has_points_of_its_own(tmp_path, synthetic):
    """Blender's Cycles lights all corners of a point by the normal of one of them: a wall that met
    a floor and a third face at an edge was black."""
    scan = synthetic.make_scan(tmp_path / "capture")
    mesh = scan.mesh
    item = components_of(scan)[0]
    one, two = item.triangles[0, :2]
    first = np.flatnonzero(mesh.face_object == 0)[0]
    a, b = mesh.triangles[first, :2]
    normal = np.cross(mesh.points[b] - mesh.points[a], mesh.corner_normals[first, 0])
    board = replace(
        mesh,
        points=np.concatenate([mesh.points, mesh.points[[a]] + mesh.corner_normals[[first], 0]]),
        triangles=np.concatenate([mesh.triangles, [[b, a, len(mesh.points)]]]).astype(np.int32),
        corner_normals=np.concatenate(
            [mesh.corner_normals, np.broadcast_to(normal, (1, 3, 3)).astype(np.float32)]
        ),
        face_object=np.append(mesh.face_object, mesh.face_object[first]),
    )
    made = components_of(replace(scan, mesh=board))[0]
    assert len(made.triangles) == len(item.triangles) + 1
    assert not np.isin(made.triangles[-1], made.triangles[:-1]).any()
    ours = item.points + item.pivot.astype(np.float32)
    theirs = made.points + made.pivot.astype(np.float32)
    np.testing.assert_allclose(theirs[made.triangles[:-1]], ours[item.triangles], atol=1e-5)
    np.testing.assert_allclose(theirs[made.triangles[-1, :2]], ours[[two, one]], atol=1e-5)


def test_far_from_the_origin_points_keep_their_place(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "capture")
    points = (scan.mesh.points + np.float32([1234.567, -987.6, 55.5])).astype(np.float32)
    moved = replace(scan, mesh=replace(scan.mesh, points=points))
    built = synthetic.build(tmp_path / "room", moved, upto="scan")
    scene = scene_from_stage(open_weaker(built.asset, "texturing"))
    order = np.argsort(scan.mesh.face_object, kind="stable")
    expected = points[scan.mesh.triangles[order]]
    np.testing.assert_array_equal(scene.points[scene.triangles], expected)


def test_an_object_may_be_called_as_what_lies_beside_it(tmp_path, synthetic):
    scan = synthetic.make_scan(tmp_path / "capture")
    labels = ("mtl", "looks", "room")
    objects = tuple(ObjectLabel(identifier=name, label=name, class_name="") for name in labels)
    scan = replace(scan, objects=objects)
    paths = ("/room/geo/mtl/mtl_mesh", "/room/geo/looks/looks_mesh", "/room/geo/room/room")
    built = synthetic.build(tmp_path / "room", scan, prims=paths)
    scene = scene_from_stage(open_measured(built.asset))
    assert tuple(obj.prim_path for obj in scene.objects) == paths
    assert validate(built.asset.root_layer) == []


def test_a_class_speaks_for_all_copies(built, tmp_path):
    layer = Sdf.Layer.CreateNew(str(tmp_path / "shot.usda"))
    for name in ("left", "right"):
        prim = Sdf.CreatePrimInLayer(layer, f"/{name}")
        prim.specifier = Sdf.SpecifierDef
        prim.referenceList.prependedItems = [Sdf.Reference(str(built.asset.root_layer))]
    said = Sdf.CreatePrimInLayer(layer, "/__class__/room_lamp")
    Sdf.AttributeSpec(said, "visibility", Sdf.ValueTypeNames.Token).default = "invisible"
    stage = Usd.Stage.Open(layer)
    for name in ("left", "right"):
        lamp = UsdGeom.Imageable(stage.GetPrimAtPath(f"/{name}/geo/lamp/lamp"))
        chair = UsdGeom.Imageable(stage.GetPrimAtPath(f"/{name}/geo/Stuhl_No_1/Stuhl_No_1"))
        assert lamp.ComputeVisibility() == "invisible"
        assert chair.ComputeVisibility() == "inherited"


def test_a_room_can_be_drawn_as_boxes(built):
    stage = opened(built.asset)
    UsdGeom.ModelAPI(stage.GetDefaultPrim()).CreateModelDrawModeAttr("bounds")
    for name in IDENTIFIERS:
        model = UsdGeom.ModelAPI(stage.GetPrimAtPath(f"/room/geo/{name}"))
        assert model.ComputeModelDrawMode() == "bounds"
        assert model.GetPrim().HasAPI(UsdGeom.ModelAPI)


def test_assets_and_components_say_who_they_are(built):
    stage = opened(built.asset, Usd.Stage.LoadNone)
    folder = built.asset.folder
    files = {"/room": built.asset.root_layer} | {
        f"/room/geo/{name}": folder / built.asset.component(name) for name in IDENTIFIERS
    }
    for path, file in files.items():
        model = Usd.ModelAPI(stage.GetPrimAtPath(path))
        assert model.GetAssetIdentifier().resolvedPath == str(file)
        assert model.GetAssetName() == path.rsplit("/", 1)[-1]
        assert model.GetAssetVersion() == "work"
        needs = [asset.resolvedPath for asset in model.GetPayloadAssetDependencies()]
        assert needs
        assert all(needs), "each is there"


def test_an_asset_is_whole_without_its_capture(built, tmp_path):
    copy = tmp_path / "elsewhere" / "room"
    shutil.copytree(built.asset.folder, copy)
    shutil.rmtree(built.scan.source)
    for file in (copy / "room.usda", *(copy / built.asset.component(x) for x in IDENTIFIERS)):
        layers, assets, missing = UsdUtils.ComputeAllDependencies(str(file))
        assert missing == []
        assert len(layers) > 5
        assert all(layer.realPath.startswith(str(copy)) for layer in layers)
        assert all(path.startswith(str(copy)) for path in assets)
    # Also without the layer that names them: poses and exposures are known all the same.
    moved = replace(built.asset, folder=copy)
    before = frames_from_stage(open_weaker(built.asset, "texturing"))
    moved.photographs_layer.unlink()
    frames = frames_from_stage(open_weaker(moved, "texturing"))
    assert len(frames) == len(before)
    np.testing.assert_array_equal(frames.world_from_camera, before.world_from_camera)
    np.testing.assert_array_equal(frames.exposure_time, before.exposure_time)
    assert validate(moved.root_layer) == []


def test_an_asset_of_the_layout_without_components_is_left_alone(built):
    refuse_old_layout(built.asset)
    old = new_layer(built.header, Provenance(role="root", version="1"))
    old.Export(str(built.asset.root_layer))
    with pytest.raises(OwnershipConflict, match=r"new folder.+edits\.usda.+\[ownership\.layout\]"):
        refuse_old_layout(built.asset)


@pytest.mark.parametrize(
    "command",
    [
        "compare ROOM ROOM -o new", "package ROOM -o new.usdz", "publish ROOM new",
        "report ROOM -o new.html", "view ROOM --no-browser", "advise ROOM",
    ],
)  # fmt: skip
def test_an_asset_of_the_layout_without_components_is_told_as_that(
    built, tmp_path, monkeypatch, capsys, command
):
    monkeypatch.chdir(tmp_path)
    old = new_layer(built.header, Provenance(role="root", version="1"))
    old.Export(str(built.asset.root_layer))
    (built.asset.folder / ".usdbrdf").mkdir()
    words = [str(built.asset.folder) if word == "ROOM" else word for word in command.split()]
    assert main(words) == 6
    (said,) = capsys.readouterr().err.splitlines()
    assert said.endswith("[ownership.layout]")
    assert not list(tmp_path.glob("new*"))


@pytest.mark.parametrize("role", ["root", "scan", "material"])
def test_an_asset_of_a_newer_version_is_not_read_as_if_it_were_ours(built, role):
    """Validate says it, too: usdbrdf.SchemaVersion."""
    open_edited(built.asset)
    layer = built.asset.root_layer if role == "root" else built.asset.layer(role)
    with edited(layer) as opened:
        about = opened.customLayerData
        about["usdbrdf"]["schemaVersion"] = 7
        opened.customLayerData = about
    readers = [open_edited] if role == "root" else [open_edited, open_measured]
    for read in readers:
        with pytest.raises(InputRefused, match=rf"{layer.name}: .+newer.+7.+\[asset\.newer\]"):
            read(built.asset)


def test_a_step_does_not_go_on_in_an_asset_of_a_newer_version(built):
    with edited(built.asset.root_layer) as opened:
        about = opened.customLayerData
        about["usdbrdf"]["schemaVersion"] = 7
        opened.customLayerData = about
    task = Task(asset=built.asset, name="fit", role="material", parameters={}, inputs={})
    with pytest.raises(InputRefused, match=r"\[asset\.newer\]"):
        task.run(lambda run: {})


def test_a_step_does_not_build_upon_layers_of_a_newer_version(built):
    with edited(built.asset.layer("scan")) as opened:
        about = opened.customLayerData
        about["usdbrdf"]["schemaVersion"] = 7
        opened.customLayerData = about
    with pytest.raises(InputRefused, match=r"\[asset\.newer\]"):
        open_weaker(built.asset, "material")


@pytest.mark.fault("C13")
@pytest.mark.parametrize(
    "command",
    [
        "convert scan -o ROOM", "ingest scan -o ROOM", "texture ROOM", "shade ROOM", "fit ROOM",
        "evaluate ROOM --views views.json -o new", "compare ROOM ROOM -o new",
        "paper ROOM ROOM -o new", "relight ROOM -o new.exr", "package ROOM -o new.usdz",
        "publish ROOM new", "report ROOM -o new.html", "view ROOM --no-browser", "advise ROOM",
        "validate ROOM",
    ],
)  # fmt: skip
def test_every_command_refuses_an_asset_whose_state_is_of_a_newer_version(
    built, tmp_path, monkeypatch, capsys, command
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scan").mkdir()
    (tmp_path / "views.json").write_text("{}")
    state = built.asset.folder / ".usdbrdf"
    state.mkdir()
    (state / "job.json").write_text('{"schema": 2}')
    words = [str(built.asset.folder) if word == "ROOM" else word for word in command.split()]
    assert main(words) == 3
    (said,) = capsys.readouterr().err.splitlines()
    assert "job.json: written by a newer usdbrdf (schema 2, this one knows 1). " in said
    assert said.endswith("[asset.newer]")
    assert not list(tmp_path.glob("new*"))


def test_who_renames_in_the_edits_is_told_where_that_goes(built):
    """The interface of a step stands in the same layer stack, where USD allows no relocates."""
    with edited(built.asset.edits_layer) as layer:
        layer.relocates = [("/room/geo/lamp", "/room/geo/lantern")]
    with pytest.raises(InputRefused, match=r"Relocates .+ in a layer that references the asset"):
        open_edited(built.asset)
    shot = Usd.Stage.CreateInMemory()
    with edited(built.asset.edits_layer) as layer:
        layer.relocates = []
    shot.DefinePrim("/set").GetReferences().AddReference(str(built.asset.root_layer))
    shot.GetRootLayer().relocates = [("/set/geo/lamp", "/set/geo/lantern")]
    assert shot.GetPrimAtPath("/set/geo/lantern/lamp").IsA(UsdGeom.Mesh)
    assert not shot.GetCompositionErrors()


def test_the_layer_that_all_objects_refer_to_is_read_once(tmp_path, monkeypatch):
    # Read anew for each it takes a time that grows as the square of their number.
    held = []
    write = interface.export

    def export(layer, path, *, folder):
        if layer.customLayerData["usdbrdf"]["role"] == "component":
            loaded = {Sdf.Layer.GetDisplayName(one) for one in Sdf.Layer.GetLoadedLayers()}
            held.append("scan.interface.usda" in loaded)
        write(layer, path, folder=folder)

    monkeypatch.setattr(interface, "export", export)
    room = make_capture(tmp_path / "room")
    assert main(["ingest", str(room.folder), "-o", str(tmp_path / "out")]) == 0
    assert held == [True] * len(room.names)
