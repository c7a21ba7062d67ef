"""Versions of an asset: complete in themselves, never changed, the same for the same content."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdUtils

from tests.asset.test_input_usd import INPUT, dress
from tests.delivery.packing import CHAIR_FILE, edit, surfaces_of
from tests.json_schemas import check
from tests.validation.faults import SURFACE, edited
from usdbrdf.asset.header import read_header
from usdbrdf.asset.layers.scan_layer import write_pending_layer
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.manifest import Manifest, changes, read_manifest, write_manifest
from usdbrdf.asset.readers import tried
from usdbrdf.asset.review import write_review
from usdbrdf.delivery.package import package, stage_in_look
from usdbrdf.delivery.publish import publish
from usdbrdf.errors import FolderBusy, InputRefused, OwnershipConflict, UsageError
from usdbrdf.files.atomic import make_folders, sha256_of
from usdbrdf.files.images import read_exr
from usdbrdf.job.ownership import folder_lock
from usdbrdf.job.stamp import Stamp, stamp_path, write_stamp
from usdbrdf.job.versions import version_around, versions_in
from usdbrdf.options import PublishOptions
from usdbrdf.page.report import report
from usdbrdf.pipeline import working_on
from usdbrdf.validation.validate import own_findings, validate, write_cures

RED = """over "room" { over "geo" { over "Stuhl_No_1" { over "mtl" {
over "Stuhl_No_1" { over "PreviewSurface" {
    float inputs:roughness = 0.125
} } } } } }"""


def bytes_of(folder):
    return {
        file.relative_to(folder).as_posix(): file.read_bytes()
        for file in folder.rglob("*")
        if file.is_file()
    }


def test_a_version_needs_nothing_else_and_is_what_the_asset_was(room, tmp_path):
    edit(room, RED)
    here = surfaces_of(stage_in_look(room.asset, "shaded"))
    told = publish(room.asset.folder, tmp_path / "dest")
    check(told, "publish")
    assert (told["version"], told["new"], told["unfinished"]) == ("v001", True, [])
    shutil.move(tmp_path / "dest/v001", moved := tmp_path / "elsewhere")
    shutil.rmtree(room.asset.folder)
    shutil.rmtree(tmp_path / "capture")
    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(moved / "room.usd"))
    assert missing == []
    assert len(assets) > 20
    for place in [*(layer.realPath for layer in layers), *assets]:
        assert place.startswith(f"{moved}{os.sep}")
    for file in moved.rglob("*.usd*"):
        assert str(tmp_path) not in Sdf.Layer.OpenAsAnonymous(str(file)).ExportToString()
    stage = Usd.Stage.Open(str(moved / "room.usd"))
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    assert {"shaded", "lit", "albedo"} <= {*looks.GetVariantNames()}
    info = stage.GetDefaultPrim().GetAssetInfo()
    assert (info["version"], info["identifier"].path) == ("v001", "./room.usd")
    there = surfaces_of(stage)
    assert there.keys() == here.keys()
    for name, surface in here.items():
        assert np.array_equal(there[name].points, surface.points)
        for part in ("diffuse", "f0", "roughness", "emission"):
            ours = getattr(surface.material, part)
            assert np.array_equal(getattr(there[name].material, part), ours), (name, part)
    assert own_findings(stage) == []


@pytest.mark.parametrize("place", ["v001", "v001/layers/new", "../latest", "../latest/new"])
def test_nothing_is_published_into_a_version(room, tmp_path, place):
    dest, folder = tmp_path / "dest", room.asset.folder
    publish(folder, dest)
    (tmp_path / "latest").symlink_to("dest/v001")
    before = bytes_of(dest)
    with pytest.raises(OwnershipConflict, match=r"is a .* version, .*\[ownership\.published\]$"):
        publish(folder, dest / place)
    assert bytes_of(dest) == before
    assert sorted(entry.name for entry in (dest / "v001").iterdir() if entry.is_dir()) == sorted(
        {path.split("/")[0] for path in read_manifest(dest / "v001").files if "/" in path}
    )


def test_the_folder_of_versions_may_be_named_by_way_of_one(room, tmp_path):
    publish(room.asset.folder, tmp_path / "dest")
    assert not publish(room.asset.folder, tmp_path / "dest" / "v001" / "..")["new"]


def test_no_version_says_where_the_capture_lay(room, tmp_path):
    def said_by(file):
        layer = Sdf.Layer.OpenAsAnonymous(str(file))
        return layer.customLayerData["usdbrdf"]["parameters"]

    for name in ("scan", "photographs"):
        layer = Sdf.Layer.OpenAsAnonymous(str(room.asset.folder / f"layers/{name}.usdc"))
        about = layer.customLayerData
        about["usdbrdf"]["parameters"] = {"adapter": "usd", "places": {"capture": "../../home/me"}}
        layer.customLayerData = about
        assert layer.Export(str(room.asset.folder / f"layers/{name}.usdc"))
    for photographs in (True, False):
        options = PublishOptions(photographs=photographs)
        version = Path(publish(room.asset.folder, tmp_path / "dest", options)["publish"])
        assert said_by(version / "layers/scan.usdc") == {"adapter": "usd"}
        assert (version / "layers/photographs.usdc").is_file() == photographs
        if photographs:
            assert said_by(version / "layers/photographs.usdc") == {"adapter": "usd"}


def test_a_layer_of_the_edits_with_a_record_of_another_kind_is_published(room, tmp_path):
    layer = Sdf.Layer.CreateNew(str(room.asset.folder / "shot.usda"))
    layer.customLayerData = {"usdbrdf": "reviewed"}
    assert layer.Save()
    edits = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    edits.subLayerPaths.append("./shot.usda")
    edits.Save()
    version = Path(publish(room.asset.folder, tmp_path / "dest")["publish"])
    (copy,) = version.rglob("shot.usda")
    assert Sdf.Layer.OpenAsAnonymous(str(copy)).customLayerData == {"usdbrdf": "reviewed"}


def test_versions_follow_each_other_and_never_change(room, tmp_path):
    dest, folder = tmp_path / "new" / "dest", room.asset.folder
    publish(folder, dest)
    first = bytes_of(dest / "v001")
    manifest = json.loads(first["manifest.json"])
    hashes = {path: hashlib.sha256(data).hexdigest() for path, data in first.items()}
    del hashes["manifest.json"]
    assert manifest["files"] == hashes
    modes = [file.stat().st_mode for file in (dest / "v001").rglob("*.usd*")]
    assert not any(mode & 0o222 for mode in modes)
    assert all(mode & 0o777 == (room.asset.root_layer.stat().st_mode & 0o444) for mode in modes)
    again = publish(folder, dest)
    assert (again["version"], again["new"]) == ("v001", False)
    edit(room, RED)
    assert publish(folder, dest)["version"] == "v002"
    assert room.asset.edits_layer.is_file()
    # What the work folder says later is not what was published.
    stage = Usd.Stage.Open(str(dest / "v001/room.usd"))
    surface = stage.GetPrimAtPath("/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/PreviewSurface")
    assert surface.GetAttribute("inputs:roughness").Get() == 0.5
    with pytest.raises(OwnershipConflict, match=r"v001: this version is there.*publish\.version"):
        publish(folder, dest, PublishOptions(version="v001"))
    with pytest.raises(UsageError, match=r"publish\.version"):
        publish(folder, dest, PublishOptions(version="1"))
    assert bytes_of(dest / "v001") == first
    assert versions_in(dest) == ["v001", "v002"]
    assert publish(folder, dest, PublishOptions(version="v002"))["new"] is False


def test_a_version_that_is_named_is_there_though_the_latest_holds_the_same(room, tmp_path):
    """A pipeline that asked for v005 looks there."""
    folder, dest = room.asset.folder, tmp_path / "dest"
    publish(folder, dest)
    told = publish(folder, dest, PublishOptions(version="v005"))
    assert (told["publish"], told["version"], told["new"]) == (str(dest / "v005"), "v005", True)
    assert read_manifest(dest / "v005").version == "v005"
    assert next(changes(dest / "v005"), None) is None
    assert publish(folder, dest, PublishOptions(version="v005"))["new"] is False
    assert publish(folder, dest)["version"] == "v005"
    with pytest.raises(UsageError, match=r"v005 is there already.*\[publish\.version\]$"):
        publish(folder, dest, PublishOptions(version="v003"))
    assert versions_in(dest) == ["v001", "v005"]


@pytest.mark.parametrize(
    "named", [{"version": "5"}, {"version": "v001/.."}, {"uri": "no address"}, {"uri": "a://{b}"}]
)
def test_what_can_be_no_name_is_refused_before_any_work(room, tmp_path, monkeypatch, named):
    monkeypatch.setattr("usdbrdf.delivery.publish.edited_files", pytest.fail)
    with pytest.raises(UsageError, match=r"\[publish\.\w+\]$"):
        publish(room.asset.folder, tmp_path / "dest", PublishOptions(**named))
    assert not (tmp_path / "dest").exists()


def test_the_same_again_is_none_where_the_folder_is_named_by_a_relative_path(
    room, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert publish(room.asset.folder, Path("versions"))["new"] is True
    again = publish(room.asset.folder, Path("versions"))
    assert (again["version"], again["new"]) == ("v001", False)


def test_a_changed_file_is_named(room, tmp_path):
    publish(room.asset.folder, tmp_path / "dest")
    version = tmp_path / "dest/v001"
    texture, extra = version / "textures/lamp.emission.exr", version / "notes.txt"
    texture.chmod(0o644)
    texture.write_bytes((version / "textures/wall.albedo.exr").read_bytes())
    (version / "previews/lit.png").unlink()
    extra.write_text("mine")
    found = own_findings(Usd.Stage.Open(str(version / "room.usd")))
    said = [f.message for f in found if f.rule == "usdbrdf.PublishedFile"]
    assert len(said) == 3
    for file, what in (
        (version / "previews/lit.png", "is missing"), (texture, "was changed"),
        (extra, "was added"),
    ):  # fmt: skip
        assert any(f"@{file}@ {what}" in message for message in said)
    # A version that was damaged holds nothing any more that would make a new one needless.
    assert publish(room.asset.folder, tmp_path / "dest")["version"] == "v002"
    manifest = version / "manifest.json"
    manifest.chmod(0o644)
    manifest.write_text(manifest.read_text().replace("0", "1", 1))
    found = own_findings(Usd.Stage.Open(str(version / "room.usd")))
    assert any("not the manifest that was published" in f.message for f in found)


def test_what_fails_half_way_leaves_nothing(room, tmp_path, monkeypatch):
    dest = tmp_path / "a/b"
    with monkeypatch.context() as patched:

        def full(*_):
            raise OSError(28, "No space left on device")

        patched.setattr("usdbrdf.delivery.publish.write_manifest", full)
        with pytest.raises(Exception, match="No space left"):
            publish(room.asset.folder, dest)
    assert not (tmp_path / "a").exists()
    # What a killed process leaves has no version's name, and goes with the next; what others are
    # making beside it stays.
    (dest / ".usdbrdf-publish/staged/.tmp-1-dead").mkdir(parents=True)
    (dest / ".tmp-2-copied").mkdir()
    publish(room.asset.folder, dest)
    assert sorted(os.listdir(dest)) == [".tmp-2-copied", ".usdbrdf-publish", "v001"]
    assert not list((dest / ".usdbrdf-publish").rglob(".tmp-*"))


def test_neither_half_a_run_nor_into_a_file(room, tmp_path):
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(OwnershipConflict, match=r"is a file.*\[publish\.destination\]$"):
        publish(room.asset.folder, file)
    assert file.read_text() == "mine"
    journal = room.asset.folder / ".usdbrdf/publishing-shade.json"
    journal.parent.mkdir(exist_ok=True)
    journal.write_text("{}")
    try:
        with pytest.raises(InputRefused, match=r"was stopped.*\[asset\.unfinished\]$"):
            publish(room.asset.folder, tmp_path / "dest")
    finally:
        journal.unlink()
    assert not (tmp_path / "dest").exists()


def test_an_asset_without_all_steps_only_if_asked_for(room, tmp_path):
    """As one whose convert was stopped after it had textured: its materials would be grey for
    good, and nobody would be told."""
    asset, dest = room.asset, tmp_path / "dest"
    header = read_header(asset.layer("scan"))
    write_pending_layer(asset.layer("material"), "material", header)
    with pytest.raises(InputRefused, match=r"the step fit was not run.+\[publish\.unfinished\]$"):
        publish(asset.folder, dest)
    assert not dest.exists()
    write_pending_layer(asset.layer("shading"), "shading", header)
    with pytest.raises(InputRefused, match=r"the steps shade and fit were not run"):
        publish(asset.folder, dest)
    told = publish(asset.folder, dest, PublishOptions(unfinished=True))
    check(told, "publish")
    assert told["unfinished"] == ["shade", "fit"]
    said = Sdf.Layer.FindOrOpen(str(dest / "v001/room.usd")).documentation
    assert said.endswith("It is unfinished: the steps shade and fit were not run.")


def test_neither_what_was_changed_by_hand_nor_steps_of_two_runs(room, tmp_path):
    """Also by a user who cannot write into the asset: nothing is asked of the folder's rights."""
    folder, dest = room.asset.folder, tmp_path / "dest"
    texturing, shading = (f"layers/{name}.usda" for name in ("texturing", "shading"))
    hashes = {layer: sha256_of(folder / layer) for layer in (texturing, shading)}

    def stamped(order, stage, layer, inputs):
        (folder / ".usdbrdf/stamps").mkdir(parents=True, exist_ok=True)
        known = {layer: sha256_of(folder / layer)}
        stamp = Stamp(stage=stage, version="1", parameters={}, inputs=inputs, outputs=known)
        write_stamp(stamp_path(folder, order, stage), stamp)

    stamped(2, "texture", texturing, {})
    stamped(3, "shade", shading, {"texturing.usda": hashes[texturing]})
    with (folder / texturing).open("a") as layer:
        layer.write("# by hand\n")
    with pytest.raises(OwnershipConflict, match=r"texturing\.usda changed.+\[ownership\.edited\]$"):
        publish(folder, dest)
    stamped(2, "texture", texturing, {})  # as if texture had run again
    with pytest.raises(InputRefused, match=r"shade was made with another texturing\.usda\..+date"):
        publish(folder, dest)
    assert not dest.exists()
    stamped(3, "shade", shading, {"texturing.usda": sha256_of(folder / texturing)})
    publish(folder, dest)


def test_a_version_is_neither_reviewed_nor_worked_in_and_bears_what_systems_leave(room, tmp_path):
    publish(room.asset.folder, tmp_path)
    version = tmp_path / "v001"
    with pytest.raises(OwnershipConflict, match=r"\[ownership\.published\]$"):
        write_review(Asset.made(version), {})
    with pytest.raises(OwnershipConflict, match=r"never.*\[ownership\.published\]$"):
        working_on(version).__enter__()
    with pytest.raises(OwnershipConflict, match=r"v001 is a .*never.*\[ownership\.published\]$"):
        working_on(version / "layers/new").__enter__()
    (version / ".DS_Store").write_bytes(b"")
    assert not list(changes(version))
    (version / "more.usda").write_text("#usda 1.0\n")
    assert [what for _, what in changes(version)] == ["was added"]


def test_what_an_artist_changed_is_theirs_in_a_version_too(room, tmp_path):
    """Though edits.usda has the record with which we made it, and lies among our layers there."""
    with edited(room.asset.edits_layer) as opened:
        surface = Sdf.CreatePrimInLayer(opened, SURFACE)
        Sdf.AttributeSpec(surface, "inputs:roughness", Sdf.ValueTypeNames.Float).default = 0.125
        assert opened.customLayerData["usdbrdf"]["role"] == "edits"
    publish(room.asset.folder, tmp_path)
    for asset in (room.asset, Asset.made(tmp_path / "v001")):
        assert own_findings(Usd.Stage.Open(str(asset.root_layer))) == []


def test_a_shot_of_other_programs_with_a_manifest_of_theirs_is_no_version(tmp_path):
    """Nor one with a damaged manifest that holds no scan."""
    shot = tmp_path / "v012"
    (shot / "layers").mkdir(parents=True)
    for text, scan, ours in (
        ('{"show": "x"}', False, False),
        ('{"files": {}, "schema"', False, False),
        ('{"files": {}, "schema"', True, True),
    ):
        (shot / "manifest.json").write_text(text)
        if scan:
            (shot / "layers/scan.usdc").touch()
        assert (version_around(shot / "study") == shot) is ours


def test_nothing_of_any_asset_is_written_into_a_version(room, tmp_path):
    """Its files alone are read-only: a folder that were is one that nobody could delete."""
    publish(room.asset.folder, tmp_path)
    version, before = tmp_path / "v001", bytes_of(tmp_path / "v001")
    for asset in (room.asset.folder, version):
        for write in (
            lambda asset: report(asset, version / "page.html"),
            lambda asset: package(asset, version / "new/room.usdz"),
            lambda asset: write_cures(Asset.made(asset), version / "fixes.usda"),
        ):
            with pytest.raises(OwnershipConflict, match=r"never.*\[ownership\.published\]$"):
                write(asset)
    assert bytes_of(version) == before
    assert {entry.name for entry in version.iterdir()} == {path.split("/")[0] for path in before}


def test_one_at_a_time(room, tmp_path):
    dest = tmp_path / "dest"
    (dest / ".usdbrdf-publish").mkdir(parents=True)
    entered, done = threading.Event(), threading.Event()

    def hold():
        with folder_lock(dest / ".usdbrdf-publish"):
            entered.set()
            done.wait(600)

    holder = threading.Thread(target=hold)
    holder.start()
    entered.wait(600)
    try:
        with pytest.raises(FolderBusy, match=r"lock\.busy"):
            publish(room.asset.folder, dest)
    finally:
        done.set()
        holder.join()


def test_a_folder_that_another_has_just_made_is_left_to_it(room, tmp_path, monkeypatch):
    """Of two publishes that began at once neither wrote anything: the one that was refused took
    the other's folder away."""
    dest = tmp_path / "a/dest"
    lock = dest / ".usdbrdf-publish"
    entered, fail = threading.Event(), threading.Event()

    def other():
        with folder_lock(lock):
            entered.set()
            fail.wait(600)
            shutil.rmtree(tmp_path / "a")  # as one that fails does

    holder = threading.Thread(target=other)

    def made_by_both(folder):
        make_folders(folder)
        if not entered.is_set():
            lock.mkdir()
            holder.start()
            entered.wait(600)

    monkeypatch.setattr("usdbrdf.delivery.publish.make_folders", made_by_both)
    try:
        with pytest.raises(FolderBusy, match=r"lock\.busy"):
            publish(room.asset.folder, dest)
        assert lock.is_dir()
        threading.Timer(0.2, fail.set).start()
        assert publish(room.asset.folder, dest, wait_s=60)["version"] == "v001"
    finally:
        fail.set()
        holder.join()
    assert sorted(os.listdir(dest)) == [".usdbrdf-publish", "v001"]


def test_nothing_is_made_of_an_asset_in_which_a_run_works(room, tmp_path):
    state = room.asset.folder / ".usdbrdf"
    state.mkdir()
    makers = {
        "publish": lambda: publish(room.asset.folder, tmp_path / "dest"),
        "package": lambda: package(room.asset.folder, tmp_path / "room.usdz"),
        "report": lambda: report(room.asset.folder, tmp_path / "room.html"),
        "validate": lambda: validate(room.asset.root_layer),
    }
    busy, entered, done = {}, threading.Event(), threading.Event()

    def work():
        with folder_lock(state):
            entered.set()
            done.wait(600)

    run = threading.Thread(target=work)
    run.start()
    entered.wait(600)
    try:
        for name, make in makers.items():
            with pytest.raises(FolderBusy) as busy[name]:
                make()
    finally:
        done.set()
        run.join()
    assert busy.keys() == makers.keys()
    assert sorted(os.listdir(tmp_path)) == ["capture", "out"]


def test_what_lies_elsewhere_is_not_published(room, tmp_path):
    edit(room, CHAIR_FILE.format("/etc/hostname"))
    with pytest.raises(InputRefused, match=r"publish\.outside"):
        publish(room.asset.folder, tmp_path / "dest")
    edit(room, CHAIR_FILE.format("./gone.exr"))
    with pytest.raises(InputRefused, match=r"gone\.exr.*publish\.missing"):
        publish(room.asset.folder, tmp_path / "dest")
    edit(room, "")
    with pytest.raises(UsageError, match=r"publish\.destination"):
        publish(room.asset.folder, room.asset.folder / "dest")
    next((tmp_path / "capture/frames").iterdir()).unlink()
    with pytest.raises(InputRefused, match=r"--no-photographs.*publish\.photograph"):
        publish(room.asset.folder, tmp_path / "dest")
    assert not (tmp_path / "dest").exists()
    publish(room.asset.folder, tmp_path / "dest", PublishOptions(photographs=False))
    stage = Usd.Stage.Open(str(tmp_path / "dest/v001/room.usd"))
    assert not (tmp_path / "dest/v001/photographs").exists()
    camera = stage.GetPrimAtPath("/room/cameras/capture")
    named = ("usdBrdf:capture:image", "backPlate:")
    assert not [n for n in camera.GetAuthoredPropertyNames() if n.startswith(named)]
    assert camera.HasAPI("UsdBrdfCaptureAPI")


def test_photographs_that_an_artist_looks_at_are_forgotten_whole(room, tmp_path):
    """With their hashes, by which anybody who has one finds it there."""
    room.asset.edits_layer.write_text("#usda 1.0\n(subLayers = [@layers/photographs.usdc@])\n")
    publish(room.asset.folder, tmp_path / "dest", PublishOptions(photographs=False))
    stage = Usd.Stage.Open(str(tmp_path / "dest/v001/room.usd"))
    told = stage.GetPrimAtPath("/room/cameras/capture").GetAuthoredPropertyNames()
    of_files = ("image", "photograph", "mask", "sha256")
    assert not {f"usdBrdf:capture:{name}" for name in of_files} & {*told}


def test_components_have_the_number_of_their_version(room, tmp_path):
    dest = tmp_path / "dest"
    publish(room.asset.folder, dest)
    edit(room, RED)
    publish(room.asset.folder, dest)
    for version in versions_in(dest):
        stage = Usd.Stage.Open(str(dest / version / "room.usd"), Usd.Stage.LoadNone)
        chair = stage.GetPrimAtPath("/room/geo/Stuhl_No_1").GetAssetInfo()
        assert chair["version"] == version
        assert chair["name"] == "Stuhl_No_1"
        assert {*stage.GetDefaultPrim().GetAssetInfo()} >= {"version", "payloadAssetDependencies"}
        found = {p.GetAssetInfo().get("version") for p in stage.TraverseAll() if p.GetAssetInfo()}
        assert found == {version}
        alone = Usd.Stage.Open(str(dest / version / room.asset.component("Stuhl_No_1")))
        told = alone.GetDefaultPrim().GetAssetInfo()
        assert (told["version"], told["name"]) == (version, "Stuhl_No_1")
        assert any(prim.IsA(UsdGeom.Mesh) for prim in alone.TraverseAll())
        assert next(changes(dest / version), None) is None
    # What says which version it is counts for no change: the same again is none.
    assert publish(room.asset.folder, dest)["new"] is False


GRAPE = """#usda 1.0
(
    defaultPrim = "grape"
)
def Xform "grape"
{
}
"""


def test_what_an_artist_references_is_tried_together(room, tmp_path, monkeypatch):
    """A child process takes a second."""
    asked = []
    child = tried.run_child

    def counted(function, arrays, task, *more):
        asked.append({Path(file).name for file in task["layers"]})
        return child(function, arrays, task, *more)

    monkeypatch.setattr(tried, "run_child", counted)
    names = {f"prop{i}.usda" for i in range(4)}
    for name in names:
        (room.asset.folder / name).write_text(f'#usda 1.0\n# {name}\ndef Xform "grape" {{\n}}\n')
    edit(
        room,
        "".join(
            f'def "p{i}" (prepend references = @./prop{i}.usda@</grape>) {{}} ' for i in range(4)
        ),
    )
    publish(room.asset.folder, tmp_path / "dest")
    assert [files for files in asked if files & names] == [names]


def test_file_formats_keep_what_they_are_told(room, tmp_path):
    (room.asset.folder / "grape.usda").write_text(GRAPE)
    edit(
        room,
        """over "room" { def "grape" (references = @./grape.usda:SDF_FORMAT_ARGS:a=b@) { } }""",
    )
    publish(room.asset.folder, tmp_path / "dest")
    version = tmp_path / "dest/v001"
    assert (version / "grape.usda").read_text() == GRAPE
    edits = Sdf.Layer.OpenAsAnonymous(str(version / "layers/edits.usda")).ExportToString()
    assert "grape.usda:SDF_FORMAT_ARGS:a=b@" in edits
    stage = Usd.Stage.Open(str(version / "room.usd"))
    assert stage.GetPrimAtPath("/room/grape").GetTypeName() == "Xform"


def test_what_a_copy_cannot_follow_is_refused(room, tmp_path):
    folder, dest = room.asset.folder, tmp_path / "dest"
    document = """<?xml version="1.0"?><materialx version="1.38">{}</materialx>"""
    image = """<input name="file" type="filename" value="a.png"/>"""
    (folder / "looks.mtlx").write_text(document.format(image))
    # References to such documents do not compose where USD comes without MaterialX.
    edit(
        room, """over "room" { def Shader "m" { asset info:mtlx:sourceAsset = @./looks.mtlx@ } }"""
    )
    with pytest.raises(InputRefused, match=r"looks\.mtlx.*edits\.usda.*\[publish\.materialx\]$"):
        publish(folder, dest)
    layer = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    layer.ImportFromString(
        '#usda 1.0\nover "room"\n{\n    def "c" (\n        clips = {\n            '
        'dictionary default = {\n                string templateAssetPath = "./c.###.usda"\n'
        "            }\n        }\n    )\n    {\n    }\n}\n"
    )
    layer.Save()
    with pytest.raises(InputRefused, match=r"'default' of </room/c>.*\[publish\.clips\]$"):
        publish(folder, dest)
    assert not dest.exists()


def test_names_for_a_resolver(room, tmp_path):
    uri = "ayon+entity://show/assets?product={name}&version={version}"
    options = PublishOptions(uri=uri, encoding="binary")
    told = publish(room.asset.folder, tmp_path / "dest", options)
    assert told["identifier"] == "ayon+entity://show/assets?product=room&version=v001"
    root = tmp_path / "dest/v001/room.usd"
    assert root.read_bytes().startswith(b"PXR-USDC")
    stage = Usd.Stage.Open(str(root))
    info = stage.GetDefaultPrim().GetAssetInfo()
    assert info["identifier"].path == told["identifier"]
    assert own_findings(stage) == []  # who asked for the address need not be warned of it
    for bad in ("room/{version}", "ayon+entity://{shot}", "ayon+entity://{", "a://{0}"):
        with pytest.raises(UsageError, match=r"publish\.uri"):
            publish(room.asset.folder, tmp_path / "dest", PublishOptions(uri=bad))


def test_a_reference_that_no_resolver_knows_is_told_as_such(room, tmp_path):
    edit(
        room, 'over "room" { def Xform "guest" (prepend references = @ayon+entity://a?b=c@ ) { } }'
    )
    with pytest.raises(
        InputRefused, match=r"an address: run usdbrdf where the resolver that knows"
    ):
        publish(room.asset.folder, tmp_path / "dest")


def test_equal_assets_give_equal_bytes(room, tmp_path):
    publish(room.asset.folder, tmp_path / "one")
    for file in room.asset.folder.rglob("*.exr"):
        os.utime(file, (1, 1))
    publish(room.asset.folder, tmp_path / "two")
    assert bytes_of(tmp_path / "one/v001") == bytes_of(tmp_path / "two/v001")


def test_textures_have_their_smaller_copies_and_the_same_pixels(room, tmp_path):
    oiio = pytest.importorskip("OpenImageIO")
    publish(room.asset.folder, tmp_path / "dest")
    name = "textures/Stuhl_No_1.base_color.exr"
    there, here = tmp_path / "dest/v001" / name, room.asset.folder / name
    image = oiio.ImageInput.open(str(there))
    assert image.spec().tile_width == 64
    sizes = []
    while image.seek_subimage(0, len(sizes)):
        sizes.append((image.spec().width, image.spec().height))
    assert sizes == [(6, 8), (3, 4), (1, 2), (1, 1)]
    assert np.array_equal(read_exr(there), read_exr(here))
    image.seek_subimage(0, 1)
    half = read_exr(here).reshape(4, 2, 3, 2, 3).mean(axis=(1, 3))
    assert image.read_image(0, 1, 0, 3, "float") == pytest.approx(half, rel=2e-3)


@pytest.mark.parametrize("path", ["/etc/passwd", "..", "../room.usda"])
def test_a_manifest_that_lists_what_lies_elsewhere_is_none(tmp_path, path):
    manifest = Manifest(
        name="room", version="1", identifier="room", texture_space="lin_rec709_scene",
        photographs=False, content="0" * 64, files={path: "1" * 64},
    )  # fmt: skip
    write_manifest(tmp_path, manifest)
    with pytest.raises(InputRefused, match=r"\[publish\.manifest\]$"):
        read_manifest(tmp_path)


def dense_grid(room, side=20):
    """The artist made the first mesh a grid of 2 side^2 triangles; its path."""
    stage = Usd.Stage.Open(str(room.asset.root_layer))
    mesh = next(UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0, 1, side + 1)] * 2))
    points = np.stack([x, y, 0.2 * np.sin(6 * x)], axis=1).astype(np.float32)
    a = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    corners = np.stack([a, a + 1, a + side + 2, a, a + side + 2, a + side + 1], axis=1).ravel()
    stage.SetEditTarget(Sdf.Layer.FindOrOpen(str(room.asset.edits_layer)))
    mesh.GetPointsAttr().Set(points)
    mesh.GetFaceVertexCountsAttr().Set(np.full(2 * side**2, 3, np.int32))
    mesh.GetFaceVertexIndicesAttr().Set(corners.astype(np.int32))
    mesh.GetExtentAttr().Set(np.stack([points.min(axis=0), points.max(axis=0)]))
    mesh.GetNormalsAttr().Block()
    UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").GetIndicesAttr().Block()
    UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").GetAttr().Set(
        np.zeros((len(corners), 2), np.float32)
    )
    stage.GetEditTarget().GetLayer().Save()
    return mesh.GetPath()


def test_stand_ins_have_few_triangles_and_lie_beside_each_mesh(room, tmp_path):
    grid, folder, dest = dense_grid(room), room.asset.folder, tmp_path / "dest"
    publish(folder, dest)
    publish(folder, dest, PublishOptions(proxies=100))
    plain, stage = (Usd.Stage.Open(str(dest / v / "room.usd")) for v in ("v001", "v002"))
    meshes = [prim for prim in plain.Traverse() if prim.IsA(UsdGeom.Mesh)]
    for prim in meshes:
        assert UsdGeom.Imageable(prim).ComputePurpose() == "default"
        shown = UsdGeom.Imageable(stage.GetPrimAtPath(prim.GetPath()))
        proxy = UsdGeom.Mesh(shown.ComputeProxyPrim()[0])
        assert (shown.ComputePurpose(), proxy.ComputePurpose()) == ("render", "proxy")
        assert proxy.GetPrim().GetParent() == shown.GetPrim().GetParent()
        assert proxy.GetDisplayColorAttr().Get() == UsdGeom.Mesh(shown).GetDisplayColorAttr().Get()
        ours, theirs = (np.array(UsdGeom.Mesh(m).GetExtentAttr().Get()) for m in (shown, proxy))
        assert np.abs(ours - theirs).max() < 0.1 * np.ptp(ours)
        count = len(proxy.GetFaceVertexCountsAttr().Get())
        corners = np.array(proxy.GetFaceVertexIndicesAttr().Get())
        assert len(corners) == 3 * count
        assert corners.max() < len(proxy.GetPointsAttr().Get())
        # Where there are none, validators of others find it.
        normals = np.array(proxy.GetNormalsAttr().Get())
        assert (len(normals), proxy.GetNormalsInterpolation()) == (3 * count, "faceVarying")
        assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
        assert 4 <= count <= (200 if prim.GetPath() == grid else 12)
    assert own_findings(stage) == []
    # Nothing of them is loaded before the payload is.
    unloaded = Usd.Stage.Open(str(dest / "v002" / "room.usd"), Usd.Stage.LoadNone)
    assert not any(prim.IsA(UsdGeom.Mesh) for prim in unloaded.Traverse())


def test_what_an_artist_references_keeps_its_own_purposes(room, tmp_path):
    stool = Usd.Stage.CreateNew(str(room.asset.folder / "stool.usda"))
    top = UsdGeom.Xform.Define(stool, "/stool")
    stool.SetDefaultPrim(top.GetPrim())
    Usd.ModelAPI(top).SetKind("component")
    seat = UsdGeom.Mesh.Define(stool, "/stool/stool")
    seat.GetPointsAttr().Set([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    seat.GetFaceVertexCountsAttr().Set([3])
    seat.GetFaceVertexIndicesAttr().Set([0, 1, 2])
    stool.GetRootLayer().Save()
    grid, folder, dest = dense_grid(room), room.asset.folder, tmp_path / "dest"
    stage = Usd.Stage.Open(str(room.asset.root_layer))
    stage.SetEditTarget(Sdf.Layer.FindOrOpen(str(room.asset.edits_layer)))
    stage.DefinePrim("/room/geo/stool").GetReferences().AddReference("./stool.usda")
    moved = UsdGeom.Xformable(stage.GetPrimAtPath(grid)).AddTranslateOp()
    moved.Set((0.0, 0.0, 4.0))
    stage.GetEditTarget().GetLayer().Save()
    publish(folder, dest, PublishOptions(proxies=100))
    stage = Usd.Stage.Open(str(dest / "v001" / "room.usd"))
    seat = UsdGeom.Imageable(stage.GetPrimAtPath("/room/geo/stool/stool"))
    assert seat.ComputePurpose() == "default"
    assert not stage.GetPrimAtPath("/room/geo/stool/stool_proxy")
    # What moves a mesh within its object moves its stand-in.
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["render", "proxy"])
    shown = stage.GetPrimAtPath(grid)
    boxes = [
        cache.ComputeWorldBound(prim).ComputeAlignedRange().GetMidpoint()
        for prim in (shown, UsdGeom.Imageable(shown).ComputeProxyPrim()[0])
    ]
    assert np.allclose(*boxes, atol=0.1)


def test_no_stand_ins_where_the_meshes_are_coarser_which_is_said(room, tmp_path, capsys):
    publish(room.asset.folder, tmp_path / "dest", PublishOptions(proxies=10**7))
    assert not (tmp_path / "dest/v001/layers/proxies.usdc").exists()
    (told,) = capsys.readouterr().err.splitlines()
    said = rf"{room.asset.folder}: --proxies 10000000: no stand-ins were made, since its meshes "
    assert re.search(said + r"have no more than \d+ triangles\.$", told)


def test_no_stand_ins_of_geometry_that_came_as_usd_which_is_said(tmp_path, synthetic, capsys):
    asset = dress(tmp_path, synthetic, INPUT).asset
    capsys.readouterr()
    told = publish(asset.folder, tmp_path / "dest", PublishOptions(proxies=1, unfinished=True))
    assert not list(Path(told["publish"]).rglob("proxies.usdc"))
    (told,) = [line for line in capsys.readouterr().err.splitlines() if "proxies" in line]
    assert told.endswith("came as USD, which keeps its own purposes.")
