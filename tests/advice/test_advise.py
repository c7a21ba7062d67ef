"""Advice on a room of which something is missing that is known: a plate whose reflection of the
lamp is seen from one side alone, and a wall."""

from __future__ import annotations

import hashlib
import json
import shutil

import numpy as np
import pytest
import trimesh
from pxr import Sdf, Usd, UsdGeom
from scipy.spatial import cKDTree

import usdbrdf
from tests.advice.plate_room import ROOM, frame_poses, highlight, mesh, write_capture
from usdbrdf.advice.words import exposure_in_words, reason
from usdbrdf.asset.advice import AdvisedObject, read_advice, write_advice
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, OwnershipConflict
from usdbrdf.job.progress import set_quiet
from usdbrdf.page.report import page_data
from usdbrdf.validation.validate import has_errors, validate


def files_of(folder):
    return {
        file.relative_to(folder).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in folder.rglob("*")
        if file.is_file() and file.name != "lock"
    }


@pytest.fixture(scope="module")
def advised(tmp_path_factory):
    """The asset's folder, its files before advice, and what was advised."""
    set_quiet(True)
    folder = tmp_path_factory.mktemp("advice")
    options = usdbrdf.ConvertOptions(
        texture=usdbrdf.TextureOptions(texel_size=0.08),
        shade=usdbrdf.ShadeOptions(sampling=usdbrdf.Sampling(standard_error=0.1, max_rays=64)),
    )
    usdbrdf.convert(write_capture(folder / "scan"), folder / "room", options)
    before = files_of(folder / "room")
    found = usdbrdf.advise(folder / "room", usdbrdf.AdviseOptions(poses=5))
    yield folder / "room", before, found
    set_quiet(False)


def test_one_pose_sees_the_reflection_that_no_frame_saw(advised):
    """By the lobe written out, on the pose that says so."""
    _, _, found = advised
    before = max(highlight(pose[:3, 3]) for pose in frame_poses())
    told = [
        (highlight(np.array(pose["eye"])), one["psi_error_expected"] / one["psi_error"])
        for pose in found["poses"]
        for one in pose["objects"]
        if one["identifier"] == "plate"
    ]
    assert max(told)[0] > 3 * before
    assert min(left for bright, left in told if bright > 3 * before) < 0.9, told


def test_the_wall_that_no_frame_shows_is_looked_at(advised):
    _, _, found = advised
    y, z = np.meshgrid(np.linspace(1.3, 2.9, 9), np.linspace(0.2, 2.2, 9))
    wall = np.stack([np.full(y.size, ROOM[0]), y.ravel(), z.ravel()], axis=1)
    seen = np.zeros(len(wall), bool)
    for pose in found["poses"]:
        way = wall - pose["eye"]
        cosine = way @ pose["direction"] / np.linalg.norm(way, axis=1)
        seen |= cosine > np.cos(np.radians(31))  # within the shorter side of the picture
    assert seen.mean() > 0.5
    assert any("east" in pose["reason"] for pose in found["poses"])


def test_cameras_stand_clear(advised):
    _, _, found = advised
    points, triangles, _, _ = mesh()
    surface = trimesh.Trimesh(points, triangles, process=False)
    eyes = np.array([pose["eye"] for pose in found["poses"]])
    dense = cKDTree(trimesh.sample.sample_surface(surface, 400_000, seed=1)[0])
    assert dense.query(eyes)[0].min() >= 0.25
    assert ((eyes[:, 2] >= 0.5) & (eyes[:, 2] <= 2.0)).all()


def test_only_a_layer_of_its_own_is_written_and_the_same_again(advised, capsys):
    folder, before, found = advised
    layer = folder / "layers/advice.usda"
    first = layer.read_bytes()
    assert main(["advise", str(folder), "--poses", "5", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found
    assert layer.read_bytes() == first
    now = files_of(folder)
    assert now.keys() - before.keys() == {"layers/advice.usda"}
    assert {name: now[name] for name in before} == before


def test_the_cameras_are_guides_and_show_where_asked_for(advised):
    folder, _, found = advised
    asset = Asset.made(folder)
    closed = Usd.Stage.Open(str(asset.root_layer))
    assert not closed.GetPrimAtPath("/room/cameras/advised_1")
    root = Sdf.Layer.CreateAnonymous()
    root.subLayerPaths = [str(asset.advice_layer), str(asset.root_layer)]
    stage = Usd.Stage.Open(root)
    for number, pose in enumerate(found["poses"], start=1):
        camera = UsdGeom.Camera(stage.GetPrimAtPath(f"/room/cameras/advised_{number}"))
        assert camera.ComputePurpose() == UsdGeom.Tokens.guide
        matrix = np.array(camera.ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
        assert matrix[3, :3] == pytest.approx(pose["eye"], abs=1e-4)
        assert -matrix[2, :3] == pytest.approx(pose["direction"], abs=1e-4)
        assert pose["reason"] in camera.GetPrim().GetDocumentation()
    assert not has_errors(validate(asset.root_layer))


def test_what_was_written_is_read_and_told_on_the_page(advised):
    folder, _, found = advised
    asset = Asset.made(folder)
    rows, current = read_advice(asset)
    assert current
    assert rows == found["poses"]
    data = page_data(asset, usdbrdf.ReportOptions(photographs=False))
    assert data["advice"] == {"poses": rows, "current": True}
    assert len(data["map"]["advised"]) == len(rows)
    layer = asset.layer("material")
    kept = layer.read_bytes()
    layer.write_bytes(kept + b"\n# changed\n")
    assert read_advice(asset)[1] is False
    layer.write_bytes(kept)


def test_where_nothing_is_advised_the_layer_stays_for_who_made_it_a_sublayer(advised):
    asset = Asset.made(advised[0])
    kept = asset.advice_layer.read_bytes()
    assert write_advice(asset, [], {}) == asset.advice_layer
    assert read_advice(asset) == ([], True)
    root = Sdf.Layer.CreateAnonymous()
    root.subLayerPaths = [str(asset.advice_layer), str(asset.root_layer)]
    stage = Usd.Stage.Open(root)
    assert not stage.GetCompositionErrors()
    assert not stage.GetPrimAtPath("/room/cameras/advised_1")
    asset.advice_layer.write_bytes(kept)


def test_a_layer_that_is_none_is_refused(advised):
    asset = Asset.made(advised[0])
    kept = asset.advice_layer.read_bytes()
    for damaged in (b"#usda 1.0\n", b"no layer", kept.replace(b"advice = {", b"other = {")):
        asset.advice_layer.write_bytes(damaged)
        with pytest.raises(InputRefused, match=r"\[advice\.layer\]"):
            read_advice(asset)
    asset.advice_layer.write_bytes(kept)


def test_a_place_that_is_not_there_is_refused(advised, tmp_path, capsys):
    folder, _, _ = advised
    assert main(["advise", str(tmp_path)]) == InputRefused.exit_code
    assert main(["advise", str(folder), "--clearance", "3"]) == InputRefused.exit_code
    assert "[advice.space]" in capsys.readouterr().err
    assert main(["advise", str(folder), "--lowest", "2", "--highest", "1"]) == 2


@pytest.mark.fault("R5")
def test_a_folder_that_cannot_be_locked_is_said(advised, tmp_path, capsys):
    shutil.copytree(advised[0], folder := tmp_path / "room")
    (folder / ".usdbrdf/lock").unlink()
    (folder / ".usdbrdf/lock").mkdir()
    assert main(["advise", str(folder)]) == 6
    assert "[ownership.place]" in capsys.readouterr().err


def test_a_published_version_is_left_alone(advised, tmp_path):
    usdbrdf_publish = usdbrdf.publish(advised[0], tmp_path / "versions")
    with pytest.raises(OwnershipConflict, match=r"\[ownership\.published\]"):
        usdbrdf.advise(usdbrdf_publish["publish"])
    assert not list((tmp_path / "versions").rglob("advice*"))


def test_json_is_as_its_schema_says(advised):
    jsonschema = pytest.importorskip("jsonschema", reason="needs the extra test")
    from tests.test_json_schemas import ROOT

    schema = json.loads((ROOT / "schemas/json/advise.schema.json").read_text("utf-8"))
    document = json.loads(json.dumps(advised[2]))
    jsonschema.Draft202012Validator(schema).validate(document)
    del document["poses"][0]["reason"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(schema).validate(document)


def test_a_reason_is_a_sentence():
    def one(reflects):
        return AdvisedObject(
            prim_path="/room/geo/ball/ball", identifier="ball", reflects=reflects,
            phi_error=0.3, psi_error=0.3, phi_error_expected=0.1, psi_error_expected=0.2,
            measured_expected=0.5,
        )  # fmt: skip

    better = "on ball: psi +-0.30 -> +-0.20, phi +-0.30 -> +-0.10"
    told = reason([one("lamp"), one("")], 0, [], 0, [])
    assert told == f"The reflection of lamp {better}; what reflects {better}."
    assert reason([one("")], 0, [], 0, []).startswith("What reflects on ball")
    assert reason([], 0, [], 1, ["lamp"]) == "lamp without clipping."
    assert reason([], 233.4, [], 0, []) == "230 m^2 that no frame shows."
    assert reason([], 0.0451, ["rug"], 0, []) == "0.045 m^2 that no frame shows (rug)."
    assert exposure_in_words(127.0, True) == "130 s"
