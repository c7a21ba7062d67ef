"""What is not packed, and what is said of it."""

from __future__ import annotations

import os
import resource
import sys

import numpy as np
import pytest
from pxr import Sdf, Usd

from tests.delivery.packing import CHAIR_FILE, edit, packed
from usdbrdf.delivery.package import look_of, package, stage_in_look, write_usdz
from usdbrdf.delivery.publish import publish
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsageError
from usdbrdf.files.images import write_exr, write_preview_png
from usdbrdf.validation.validate import own_findings


@pytest.mark.fault("S2")
@pytest.mark.parametrize(
    "path", ["/etc/hostname", "../../../../../../../../etc/hostname", "./textures/link.exr"]
)
def test_files_outside_are_refused(room, tmp_path, path):
    secret = tmp_path / "secret.exr"
    write_exr(secret, np.zeros((2, 2, 3), np.float32))
    (room.asset.folder / "textures/link.exr").symlink_to(secret)
    edit(room, CHAIR_FILE.format(path))
    for name in ("room.usdz", "room.glb"):
        with pytest.raises(InputRefused, match=r"package\.outside"):
            packed(room, tmp_path, name)
        assert not (tmp_path / "out of it" / name).exists()


@pytest.mark.parametrize("path", ["https://example.org/a.png", "file:///etc/hostname"])
def test_addresses_are_refused_as_such(room, tmp_path, path):
    edit(room, CHAIR_FILE.format(path))
    with pytest.raises(InputRefused, match=rf"^{path}: files from the network are not packaged"):
        packed(room, tmp_path)


@pytest.mark.fault("S2")
def test_a_refusal_leaves_no_folder_behind(room, tmp_path):
    edit(room, CHAIR_FILE.format("./gone.exr"))
    (tmp_path / "there").mkdir()
    for folder in ("a/b", "there/c", "there"):
        with pytest.raises(InputRefused, match=r"package\.missing"):
            package(room.asset.folder, tmp_path / folder / "room.usdz")
    assert not (tmp_path / "a").exists()
    assert not (tmp_path / "there/c").exists()


def test_what_usd_says_of_a_failure_is_told_without_its_source(room, tmp_path):
    edit(room, 'over "room" { def "prop" ( references = @./gone.usda@ ) {} }')
    with pytest.raises(
        InputRefused, match=r"gone\.usda: this layer, which .*edits\.usda names.*Bring it back"
    ):
        packed(room, tmp_path)
    room.asset.edits_layer.write_text('#usda 1.0\nover "room" {')
    with pytest.raises(InputRefused, match=r"edits\.usda:2:.*Correct") as of_layer:
        packed(room, tmp_path)
    room.asset.root_layer.write_text('#usda 1.0\ndef "room" {')
    with pytest.raises(InputRefused, match=r"room\.usda:2:.*Correct") as of_root:
        packed(room, tmp_path)
    with pytest.raises(EnvironmentFailure, match="could not be written") as of_disk:
        write_usdz(tmp_path / "no folder/x.usdz", tmp_path, [])
    for told in (of_layer, of_root, of_disk):
        assert "pxr" not in str(told.value)
        assert " at line " not in str(told.value)


def test_other_attributes_bring_no_file_in(room, tmp_path):
    edit(room, 'over "room" { custom asset userProperties:note = @/etc/hostname@ }')
    with pytest.raises(InputRefused, match=r"package\.outside"):
        packed(room, tmp_path)


def test_a_layer_from_elsewhere_is_refused(room, tmp_path):
    (tmp_path / "mine.usda").write_text('#usda 1.0\nover "room" {}\n')
    edits = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    edits.subLayerPaths = [str(tmp_path / "mine.usda")]
    edits.Save()
    with pytest.raises(InputRefused, match=r"mine\.usda.*package\.outside"):
        packed(room, tmp_path)


@pytest.mark.parametrize(
    ("path", "code"),
    [("./note.txt", "package.format"), ("./gone.exr", "package.missing"), ("./x.exr", "image")],
)
def test_what_is_no_picture_is_refused(room, tmp_path, path, code):
    (room.asset.folder / "note.txt").write_text("mine")
    (room.asset.folder / "x.exr").write_text("no picture")
    edit(room, CHAIR_FILE.format(path))
    with pytest.raises(InputRefused, match=code):
        packed(room, tmp_path)


def test_pictures_that_are_not_what_their_names_say_are_refused(room, tmp_path):
    """It was said that the disk is full."""
    write_preview_png(tmp_path / "x.png", np.full((2, 3, 3), 99, np.uint8))
    (tmp_path / "x.png").rename(room.asset.folder / "x.exr")
    edit(room, CHAIR_FILE.format("./x.exr"))
    with pytest.raises(InputRefused, match=r"x\.exr: it holds .+ called \.exr.+image\.name\]$"):
        packed(room, tmp_path)
    with pytest.raises(InputRefused, match=r"image\.name\]$"):
        packed(room, tmp_path, whole=True)
    with pytest.raises(InputRefused, match=r"image\.name\]$"):
        publish(room.asset.folder, tmp_path / "dest")
    [found] = own_findings(Usd.Stage.Open(str(room.asset.root_layer)))
    assert (found.rule, found.severity.name) == ("usdbrdf.UnreadableTexture", "ERROR")
    assert "Rename it" in found.message


def test_an_asset_of_which_nothing_is_measured_yet(synthetic, tmp_path):
    scan = synthetic.make_scan(tmp_path / "capture")
    new = synthetic.build(tmp_path / "new", scan, upto="scan").asset
    with pytest.raises(InputRefused, match=r"no look yet\. Run usdbrdf convert.*package\.look"):
        package(new.folder, tmp_path / "new.usdz")
    textured = synthetic.build(tmp_path / "textured", scan, upto="texturing").asset
    assert look_of(stage_in_look(textured)) == "lit"


def test_a_file_in_the_place_of_the_folder(room, tmp_path):
    with pytest.raises(InputRefused, match=r"Name the folder.*\[asset\.missing\]"):
        package(room.asset.edits_layer, tmp_path / "room.usdz")
    # The root layer stands for its folder, as on the command line.
    found = package(room.asset.root_layer, tmp_path / "room.usdz")
    assert found["bytes"] == (tmp_path / "room.usdz").stat().st_size


@pytest.mark.parametrize(
    ("name", "told"), [("file/room.usdz", r"file.*\[environment\.io\]$"), ("a.glb", "needs Pillow")]
)
def test_what_cannot_be_written_is_refused_before_any_work(room, tmp_path, monkeypatch, name, told):
    monkeypatch.setattr("usdbrdf.delivery.package.stage_in_look", pytest.fail)
    monkeypatch.setitem(sys.modules, "PIL", None)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(EnvironmentFailure, match=told):
        package(room.asset.folder, tmp_path / name)
    assert sorted(os.listdir(tmp_path)) == ["capture", "file", "out"]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("room.zip", {}),
        ("room.glb", {"profile": "arkit"}),
        ("room.glb", {"textures": "exr"}),
        ("room.usdz", {"profile": "arkit", "textures": "exr"}),
        ("room.usdz", {"max_size": 0}),
        ("room.usdz", {"look": "sunny"}),
    ],
)
def test_options_that_cannot_be(room, tmp_path, name, options):
    with pytest.raises(UsageError):
        packed(room, tmp_path, name, **options)


@pytest.mark.fault("R1")
def test_a_disk_that_takes_half_of_a_package_is_no_defect(tmp_path):
    """USD's writer says that all is well, and opens what it wrote."""
    (tmp_path / "room.usda").write_text(
        '#usda 1.0\ndef "a" {\n    asset picture = @./a.png@\n    asset other = @./b.png@\n}\n'
    )
    for name in ("a.png", "b.png"):
        (tmp_path / name).write_bytes(os.urandom(50_000))
    made = tmp_path / "out" / "room.usdz"
    made.parent.mkdir()
    for limit in (100, 1000, 40_000, 60_000, 100_000):
        limits = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
        try:
            with pytest.raises(EnvironmentFailure, match=r"\(ulimit -f\).*\[package.write\]"):
                write_usdz(made, tmp_path, ["room.usda", "a.png", "b.png"])
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert not list(made.parent.iterdir())
    write_usdz(made, tmp_path, ["room.usda", "a.png", "b.png"])


def test_names_that_are_not_ascii_are_packed(tmp_path):
    (tmp_path / "room.usda").write_text(
        '#usda 1.0\ndef "a" {\n    asset picture = @./Stühle.png@\n}\n', "utf-8"
    )
    (tmp_path / "Stühle.png").write_bytes(b"picture")
    made = tmp_path / "room.usdz"
    write_usdz(made, tmp_path, ["room.usda", "Stühle.png"])
    assert Sdf.ZipFile.Open(str(made)).GetFileNames() == ["room.usda", "Stühle.png"]


@pytest.mark.parametrize(("name", "profile"), [("room.usdz", "default"), ("room.usdz", "arkit"),
                                               ("room.glb", "default")])  # fmt: skip
def test_an_asset_whose_objects_are_all_set_aside_is_no_package(room, tmp_path, name, profile):
    edit(room, 'over "room" { over "geo" ( active = false ) {} }')
    with pytest.raises(InputRefused, match=r"edits\.usda sets aside\. \[package\.empty\]$"):
        packed(room, tmp_path, name, profile=profile)
    assert not (tmp_path / "out of it").exists()
