"""A whole conversion: what is in the asset, what later runs change, and what they leave alone."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdShade

import usdbrdf
from tests.scenes import MadeCapture, edited, make_capture, poses_down_and_up, write_ply
from usdbrdf.asset.layers.looks import VARIANT_SET
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import open_edited, open_measured, open_weaker
from usdbrdf.asset.readers.scene import (
    frames_from_stage,
    read_aovs,
    read_fit,
    read_shading,
    scene_from_stage,
)
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.colour import to_display_srgb8
from usdbrdf.files.images import read_exr, write_exr, write_preview_png
from usdbrdf.job.progress import set_quiet
from usdbrdf.job.stamp import hash_of_files
from usdbrdf.kernel import num_threads

OPTIONS = usdbrdf.ConvertOptions(
    texture=usdbrdf.TextureOptions(texel_size=0.2),
    shade=usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64)),
    fit=usdbrdf.FitOptions(max_pixels=60),
)
COARSE = ["-q", "--texel-size", "0.2", "--standard-error", "0.1", "--rays", "64"]
COARSE += ["--max-pixels", "60"]
MAPS = ("lit", "mean", "spread", "samples", "coverage", "irradiance", "stderr", "albedo")
LOOKS = {"shaded", "roughness", "specular", *MAPS}
# Dim enough, in the light of the others, not to be taken for a lamp itself.
CEILING = {"ceiling": (0.125, 0.125, 0.125)}


@pytest.fixture(autouse=True)
def _quiet():
    set_quiet(True)
    yield
    set_quiet(False)


def add_hidden_object(capture: MadeCapture) -> None:
    """A square below the floor, where no camera ever looks."""
    square = np.array([[0, 0, -1], [1, 0, -1], [1, 1, -1], [0, 1, -1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(capture.points)
    number = len(capture.names)
    write_ply(
        capture.folder / "mesh.ply",
        np.concatenate([capture.points, square]),
        np.concatenate([capture.triangles, faces]),
        np.concatenate([capture.face_object, [number, number]]),
    )
    with edited(capture.folder / "objects.json") as document:
        document["objects"].append({"id": number, "name": "hidden", "class_name": "hidden"})


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return tmp_path_factory.mktemp("convert")


@pytest.fixture(scope="module")
def capture(base):
    made = make_capture(
        base / "scan", subdivisions=2, poses=poses_down_and_up(6, 6), radiance=CEILING
    )
    add_hidden_object(made)
    return made


@pytest.fixture(scope="module")
def converted(base, capture):
    return usdbrdf.convert(capture.folder, base / "made" / "room", OPTIONS)


@pytest.fixture(scope="module")
def asset(base, converted):
    return Asset.at(base / "made" / "room")


@pytest.fixture
def copy(base, asset, request):
    """The asset once more, as far from the capture, to be changed."""
    folder = base / request.node.name / "room"
    shutil.copytree(asset.folder, folder)
    yield Asset.at(folder)
    shutil.rmtree(folder.parent)


def prim_of(stage: Usd.Stage, name: str) -> Usd.Prim:
    return stage.GetPrimAtPath(f"{stage.GetDefaultPrim().GetPath()}/geo/{name}/{name}")


def surface_of(prim: Usd.Prim) -> UsdShade.Shader:
    """The shader of the material that a renderer finds for the prim."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    assert material, f"<{prim.GetPath()}> has no material"
    return material.ComputeSurfaceSource()[0]


def in_each_look(stage: Usd.Stage):
    variants = stage.GetDefaultPrim().GetVariantSets().GetVariantSet(VARIANT_SET)
    for look in variants.GetVariantNames():
        variants.SetVariantSelection(look)
        yield look


def assert_dressed(stage: Usd.Stage, prims: list[Usd.Prim]) -> None:
    """Every prim has a material in every look, every material roughness and ior."""
    assert prims
    looks = set()
    for look in in_each_look(stage):
        looks.add(look)
        for path in [prim.GetPath() for prim in prims]:
            surface = surface_of(stage.GetPrimAtPath(path))
            assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
            for name in ("roughness", "ior", "metallic", "useSpecularWorkflow"):
                assert surface.GetInput(name).GetAttr().HasAuthoredValue(), (look, path, name)
    assert looks >= LOOKS


def state(folder: Path) -> dict[str, tuple[int, int]]:
    """Inode and time of change of every file but the lock, which each run signs."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != "lock"]
    return {str(path): (path.stat().st_ino, path.stat().st_mtime_ns) for path in files}


def contents(folder: Path, *parts: str) -> dict[str, str]:
    files = [path for part in parts for path in sorted((folder / part).glob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): sha256_of(path) for path in files}


# What is in the asset


def test_what_each_step_found(converted):
    assert list(converted) == ["ingest", "texture", "shade", "fit"]
    assert all(result.reran for result in converted.values())
    assert converted["ingest"].summary["radiometric"] is True
    assert converted["texture"].summary["unseen_objects"] == ["hidden"]
    assert converted["shade"].summary["emitters"] == ["lamp"]


def test_all_layers_and_textures_are_there(capture, asset):
    assert asset.root_layer.is_file()
    assert asset.edits_layer.is_file()
    layers = {path.name for path in (asset.folder / "layers").iterdir()}
    assert layers == {
        "scan.usdc", "texturing.usda", "texturing_uv.usdc", "shading.usda", "lights.usda",
        "material.usda", "contents.usda", "photographs.usdc",
        *(f"{role}.interface.usda" for role in ROLES),
    }  # fmt: skip
    textures = {path.name for path in (asset.folder / "textures").iterdir()}
    names = [*capture.names, "hidden"]
    assert textures >= {f"{name}.{aov}.exr" for name in names for aov in MAPS}
    stage = open_edited(asset)
    for name in names:
        for aov in read_aovs(stage, str(prim_of(stage, name).GetPath())):
            assert np.isfinite(read_exr(asset.folder / aov.file)).all()


def test_every_object_has_a_whole_material_in_every_look(capture, asset):
    stage = open_edited(asset)
    assert_dressed(stage, [prim_of(stage, name) for name in (*capture.names, "hidden")])


@pytest.mark.fault("L2")
def test_an_object_that_no_frame_sees_is_neutral_and_says_so(asset):
    stage = open_edited(asset)
    assert read_fit(stage, str(prim_of(stage, "hidden").GetPath())).status == "unseen"
    assert prim_of(stage, "hidden").GetAttribute("usdBrdf:fit:status").Get() == "unseen"
    target = "usdBrdf:fit:targetFrame"
    assert prim_of(stage, "hidden").GetAttribute(target).Get() == -1
    assert 0 <= prim_of(stage, "ceiling").GetAttribute(target).Get() < 12
    textures = asset.folder / "textures"
    assert (read_exr(textures / "hidden.coverage.exr") == 0).all()
    assert (read_exr(textures / "hidden.samples.exr") == 0).all()
    np.testing.assert_array_equal(read_exr(textures / "hidden.albedo.exr"), 0.5)
    for name in ("floor", "walls", "box"):
        fitted = read_fit(stage, str(prim_of(stage, name).GetPath()))
        assert fitted.status in ("measured", "undetermined")


def test_the_lamp_is_an_emitter_with_its_own_light(capture, asset):
    stage = open_edited(asset)
    lamp = prim_of(stage, "lamp")
    shading = read_shading(stage, str(lamp.GetPath()))
    assert shading.emitter
    np.testing.assert_allclose(shading.radiance, capture.radiance["lamp"], rtol=0.01)
    surface = surface_of(lamp)
    assert surface.GetInput("diffuseColor").Get() == (0, 0, 0)
    source = surface.GetInput("emissiveColor").GetConnectedSources()[0][0].source
    file = UsdShade.Shader(source.GetPrim()).GetInput("file").Get()
    emission = read_exr(Path(file.resolvedPath))
    assert Path(file.resolvedPath).name == "lamp.emission.exr"
    np.testing.assert_allclose(emission.max(axis=(0, 1)), capture.radiance["lamp"], rtol=0.01)
    others = [name for name in capture.names if name != "lamp"]
    assert not any(prim_of(stage, name).HasAPI("UsdBrdfEmitterAPI") for name in others)


# Later runs


def test_a_second_run_touches_nothing(capture, asset):
    before = state(asset.folder)
    again = usdbrdf.convert(capture.folder, asset.folder, OPTIONS)
    assert not any(result.reran for result in again.values())
    assert state(asset.folder) == before


def test_textures_that_were_deleted_come_back(capture, asset, copy):
    shutil.rmtree(copy.folder / "textures")
    again = usdbrdf.convert(capture.folder, copy.folder, OPTIONS)
    assert [name for name, result in again.items() if result.reran] == ["texture", "shade", "fit"]
    assert contents(copy.folder, "textures") == contents(asset.folder, "textures")


def test_an_artists_override_survives_other_parameters(capture, copy):
    stage = open_edited(copy)
    stage.SetEditTarget(Sdf.Layer.FindOrOpen(str(copy.edits_layer)))
    surface_of(prim_of(stage, "box")).GetInput("roughness").Set(0.125)
    stage.GetEditTarget().GetLayer().Save()
    mine = copy.edits_layer.read_bytes()
    root = copy.root_layer.read_bytes()
    del stage
    other = replace(OPTIONS, texture=replace(OPTIONS.texture, quantile=0.4))
    again = usdbrdf.convert(capture.folder, copy.folder, other)
    assert [name for name, result in again.items() if result.reran] == ["texture", "shade", "fit"]
    assert copy.edits_layer.read_bytes() == mine
    assert copy.root_layer.read_bytes() == root
    stage = open_edited(copy)
    assert surface_of(prim_of(stage, "box")).GetInput("roughness").Get() == 0.125
    measured = open_measured(copy)
    assert surface_of(prim_of(measured, "box")).GetInput("roughness").Get() != 0.125


def test_a_capture_in_other_units_does_not_fit_the_root(capture, copy):
    before = state(copy.folder)
    place = [str(capture.folder), "-o", str(copy.folder)]
    assert main(["ingest", "-q", *place, "--meters-per-unit", "0.01"]) == 6
    assert {name: state(copy.folder)[name] for name in before} == before


@pytest.mark.fault("R13")
def test_the_number_of_threads_changes_nothing(base, capture, asset):
    threads = 3
    assert num_threads() != threads
    others = base / "others" / "room"
    environment = {"PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_NUM_THREADS": str(threads)}
    done = subprocess.run(
        [sys.executable, "-m", "usdbrdf", "convert", capture.folder, "-o", others, *COARSE],
        env={**os.environ, **environment},
    )
    assert done.returncode == 0
    one, many = (contents(folder, "textures", "layers") for folder in (asset.folder, others))
    assert one == many


# Other inputs


@pytest.mark.fault("G9")
def test_without_labels_connected_parts_are_the_objects(tmp_path):
    made = make_capture(tmp_path / "scan", subdivisions=1)
    write_ply(made.folder / "mesh.ply", made.points, made.triangles)
    (made.folder / "objects.json").unlink()
    found = usdbrdf.convert(made.folder, tmp_path / "room", OPTIONS)
    assert found["ingest"].summary["objects"] == 3  # the room, the lamp in it, the box on its floor
    stage = open_edited(Asset.at(tmp_path / "room"))
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert len(meshes) == 3
    assert_dressed(stage, meshes)


@pytest.mark.fault("I10")
def test_photographs_give_a_result_that_is_not_called_radiometric(tmp_path, capsys):
    made = make_capture(tmp_path / "scan", subdivisions=1)
    for image in sorted((made.folder / "frames").iterdir()):
        write_preview_png(
            image.with_suffix(".png"), to_display_srgb8(read_exr(image), exposure_scale=1.0)
        )
        image.unlink()
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            frame["file_path"] = frame["file_path"].replace(".exr", ".png")
            del frame["saturation_radiance"], frame["noise_floor_radiance"]
    call = ["convert", str(made.folder), "-o", str(tmp_path / "room"), "--json", *COARSE]
    assert main(call) == 3
    assert capsys.readouterr().out == ""
    assert main([*call, "--assume-srgb"]) == 0
    told = json.loads(capsys.readouterr().out)["steps"]["ingest"]
    assert told["radiometric"] is False
    assert any("[capture.ldr]" in warning for warning in told["warnings"])
    stage = open_edited(Asset.at(tmp_path / "room"))
    assert frames_from_stage(stage).radiometric is False


@pytest.mark.fault("C10")
def test_a_lamp_that_saturates_in_every_frame_is_a_lower_bound(tmp_path):
    made = make_capture(
        tmp_path / "scan",
        subdivisions=1,
        poses=poses_down_and_up(6, 6),
        radiance=CEILING,
        size=(48, 36),
        saturation_radiance=4.0,
    )
    found = usdbrdf.convert(made.folder, tmp_path / "room", OPTIONS)
    assert found["texture"].summary["clipped_fraction"] > 0
    assert found["shade"].summary["emitters"] == ["lamp"]
    stage = open_edited(Asset.at(tmp_path / "room"))
    lamp = prim_of(stage, "lamp")
    assert lamp.GetAttribute("usdBrdf:emitter:lowerBound").Get() is True
    np.testing.assert_allclose(lamp.GetAttribute("usdBrdf:emitter:radiance").Get(), 4.0, rtol=0.01)
    assert 0.5 in read_exr(tmp_path / "room/textures/lamp.coverage.exr")


@pytest.mark.fault("G13")
def test_an_environment_lights_an_open_scene_by_pi_times_its_radiance(tmp_path):
    made = make_capture(tmp_path / "scan", subdivisions=1, room=False)
    folder = tmp_path / "box"
    coarse = replace(
        OPTIONS,
        texture=replace(OPTIONS.texture, texel_size=0.1),
        shade=replace(OPTIONS.shade, denoise="none", environment="none"),
        fit=replace(OPTIONS.fit, environment="none"),
    )
    usdbrdf.convert(made.folder, folder, coarse)
    file = folder / "textures" / "box.irradiance.exr"
    # A box is convex: without surroundings, nothing shines on it.
    assert (read_exr(file) == 0).all()
    radiance = np.array([0.5, 0.25, 0.125], np.float32)
    write_exr(tmp_path / "sky.exr", np.tile(radiance, (8, 16, 1)))
    with usdbrdf.working_on(folder) as asset:
        usdbrdf.shade(asset, replace(coarse.shade, environment=tmp_path / "sky.exr"))
    irradiance = read_exr(file)
    lit = irradiance.any(axis=2)
    assert lit.sum() > 100
    np.testing.assert_allclose(
        irradiance[lit], np.broadcast_to(np.pi * radiance, (lit.sum(), 3)), rtol=2e-3
    )


# USD as input


GEOMETRY = """#usda 1.0
(
    defaultPrim = "haus"
    metersPerUnit = 0.01
    upAxis = "Y"
)

def Xform "haus"
{{
    def Scope "mtl"
    {{
        def Material "own"
        {{
            token outputs:surface.connect = </haus/mtl/own/s.outputs:surface>
            def Shader "s"
            {{
                uniform token info:id = "UsdPreviewSurface"
                color3f inputs:diffuseColor = (1, 0, 1)
                token outputs:surface
            }}
        }}
    }}
{meshes}
}}
"""
MESH = """
    def Mesh "{name}" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    )
    {{
        uniform token subdivisionScheme = "none"
        point3f[] points = {points}
        int[] faceVertexCounts = {counts}
        int[] faceVertexIndices = {indices}
        rel material:binding = </haus/mtl/own>
    }}
"""


def as_usd(made: MadeCapture, path: Path) -> None:
    """The capture's mesh as a stage in centimetres with y up, and its poses to match."""
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    points = 100 * made.points.astype(np.float64) @ turn[:3, :3].T
    meshes = ""
    for i, name in enumerate(made.names):
        faces = made.triangles[made.face_object == i]
        used, own = np.unique(faces, return_inverse=True)
        meshes += MESH.format(
            name=name,
            points=[tuple(point) for point in points[used].round(4).tolist()],
            counts=[3] * len(faces),
            indices=own.ravel().tolist(),
        )
    path.write_text(GEOMETRY.format(meshes=meshes))
    with edited(made.manifest) as document:
        for frame in document["frames"]:
            pose = turn @ np.array(frame["transform_matrix"])
            pose[:3, 3] *= 100
            frame["transform_matrix"] = pose.tolist()


def test_a_usd_stage_stays_as_it_is_and_wears_our_materials(tmp_path, monkeypatch):
    made = make_capture(
        tmp_path / "scan", subdivisions=2, poses=poses_down_and_up(6, 6), radiance=CEILING
    )
    as_usd(made, tmp_path / "haus.usda")
    before = (tmp_path / "haus.usda").read_bytes()
    monkeypatch.chdir(tmp_path)
    place = ["scan", "-o", "room", "--mesh", "haus.usda"]
    assert main(["convert", *place, *COARSE]) == 0
    assert (tmp_path / "haus.usda").read_bytes() == before
    asset = Asset.at(tmp_path / "room")
    stage = open_edited(asset)
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert [prim.GetName() for prim in meshes] == list(made.names)
    assert_dressed(stage, meshes)
    for look in in_each_look(stage):
        for prim in meshes:
            path = str(surface_of(prim).GetPath())
            assert not path.startswith("/room/mtl/own"), (look, path)
    shading = read_shading(stage, "/room/lamp")
    np.testing.assert_allclose(shading.radiance, made.radiance["lamp"], rtol=0.01)


def layered_usd(made, folder):
    """The capture's meshes in one layer that another one sublayers: (that one, the meshes')."""
    folder.mkdir()
    top, below = folder / "top.usda", folder / "below.usda"
    as_usd(made, below)
    layer = Sdf.Layer.CreateNew(str(top))
    layer.subLayerPaths = ["./below.usda"]
    layer.defaultPrim = "haus"
    layer.Save()
    return top, below


def test_layers_that_a_usd_stage_refers_to_are_inputs_too(tmp_path):
    made = make_capture(tmp_path / "scan", subdivisions=1)
    top, below = layered_usd(made, tmp_path / "geometry")
    options = usdbrdf.IngestOptions(mesh=top)
    with usdbrdf.working_on(tmp_path / "room") as asset:
        assert usdbrdf.ingest(made.folder, asset, options).reran
        below.write_text(below.read_text() + "# changed\n")
        again = usdbrdf.ingest(made.folder, asset, options)
    assert again.reason == "inputs changed: mesh"


def test_files_in_allowed_folders_are_inputs_too(tmp_path):
    made = make_capture(tmp_path / "scan", subdivisions=1)
    (tmp_path / "shared").mkdir()
    mesh = (made.folder / "mesh.ply").rename(tmp_path / "shared" / "mesh.ply")
    with edited(made.manifest) as document:
        document["mesh"] = "../shared/mesh.ply"
    options = usdbrdf.IngestOptions(allow_outside=(tmp_path / "shared",))
    with usdbrdf.working_on(tmp_path / "room") as asset:
        assert usdbrdf.ingest(made.folder, asset, options).reran
        assert not usdbrdf.ingest(made.folder, asset, options).reran
        write_ply(mesh, made.points * np.float32(1.001), made.triangles, made.face_object)
        again = usdbrdf.ingest(made.folder, asset, options)
    assert again.reason == "inputs changed: outside-0"


# Inputs that are moved or changed


@pytest.fixture
def moving(tmp_path):
    """A capture and an asset that has all it needs to be textured."""
    made = make_capture(tmp_path / "scan", subdivisions=1)
    with usdbrdf.working_on(tmp_path / "made/room") as asset:
        usdbrdf.ingest(made.folder, asset, OPTIONS.ingest)
    return made.folder, asset.folder


@pytest.mark.parametrize("moved", ["capture", "asset"])
def test_what_was_moved_is_found_again(tmp_path, moving, moved):
    capture, folder = moving
    (tmp_path / "far/away").mkdir(parents=True)
    if moved == "capture":
        capture = capture.rename(tmp_path / "far/away/scan")
    else:
        folder = folder.rename(tmp_path / "far/away/room")
    with usdbrdf.working_on(folder) as asset:
        with pytest.raises(InputRefused, match=r"0000\.exr: .+missing.+convert.+capture again"):
            usdbrdf.texture(asset, OPTIONS.texture)
        assert usdbrdf.ingest(capture, asset, OPTIONS.ingest).reran
        assert usdbrdf.texture(asset, OPTIONS.texture).reran
        assert not usdbrdf.ingest(capture, asset, OPTIONS.ingest).reran


def test_what_moves_together_stays_done(tmp_path, moving):
    (tmp_path / "elsewhere").mkdir()
    capture, folder = (path.relative_to(tmp_path) for path in moving)
    for top in ("scan", "made"):
        (tmp_path / top).rename(tmp_path / "elsewhere" / top)
    with usdbrdf.working_on(tmp_path / "elsewhere" / folder) as asset:
        assert not usdbrdf.ingest(tmp_path / "elsewhere" / capture, asset, OPTIONS.ingest).reran


def test_frames_that_changed_places_are_other_inputs(tmp_path):
    files = [tmp_path / camera / "0001.exr" for camera in ("cam0", "cam1")]
    for i, file in enumerate(files):
        file.parent.mkdir()
        file.write_bytes(bytes([i]))
    before = hash_of_files(files)
    assert hash_of_files(files) == before
    assert hash_of_files(reversed(files)) != before


def test_a_changed_usd_stage_is_textured_again(tmp_path):
    made = make_capture(tmp_path / "scan", subdivisions=1)
    top, below = layered_usd(made, tmp_path / "geometry")
    with usdbrdf.working_on(tmp_path / "room") as asset:
        usdbrdf.ingest(made.folder, asset, usdbrdf.IngestOptions(mesh=top))
        assert usdbrdf.texture(asset, OPTIONS.texture).reran
        assert not usdbrdf.texture(asset, OPTIONS.texture).reran
        below.write_text(below.read_text() + "# changed\n")
        again = usdbrdf.texture(asset, OPTIONS.texture)
    assert again.reason == "inputs changed: geometry"


def test_the_crease_angle_holds_for_a_usd_stage_without_normals(tmp_path):
    made = make_capture(tmp_path / "scan", subdivisions=1)
    as_usd(made, tmp_path / "haus.usda")
    normals = {}
    with usdbrdf.working_on(tmp_path / "room") as asset:
        for angle in (0.0, 180.0):
            options = usdbrdf.IngestOptions(mesh=tmp_path / "haus.usda", crease_angle_deg=angle)
            usdbrdf.ingest(made.folder, asset, options)
            scene = scene_from_stage(open_weaker(asset, "texturing"))
            box = next(item for item in scene.objects if item.label == "box")
            normals[angle] = scene.corner_normals[box.faces]
    assert (np.abs(normals[0.0]).max(axis=2) > 0.999).all()
    assert (np.abs(normals[180.0]).max(axis=2) < 0.999).any()
