"""Damaged layers are made again by the run that made them, and litter makes nothing run again."""

from __future__ import annotations

import os
import shutil

import pytest

from tests.nondestruction.conftest import COARSE, bytes_of, convert
from usdbrdf.asset.layers.interface import is_cut, mend_root
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main

PARTS = ("layers", "textures", "previews")


@pytest.fixture
def copied(base, converted, request):
    """The converted asset, as far from the capture as before."""
    folder = base / f"copy-{abs(hash(request.node.name))}" / "room"
    shutil.copytree(converted.folder, folder)
    yield folder
    shutil.rmtree(folder.parent)


def cut(path, bytes_gone=500):
    size = path.stat().st_size
    assert size > bytes_gone
    os.truncate(path, size - bytes_gone)


@pytest.mark.parametrize("options", [(), ("--adopt",), ("--discard",)])
@pytest.mark.parametrize("name", ["scan.usdc", "texturing_uv.usdc"])
def test_a_damaged_binary_layer_is_made_again(capture, converted, copied, name, options):
    cut(copied / "layers" / name)
    convert(capture, copied, *options)
    for part in PARTS:
        assert bytes_of(copied / part) == bytes_of(converted.folder / part)
    assert not list(copied.glob("adopted-*"))


def test_a_damaged_root_is_made_again_once_it_is_removed(capture, converted, copied, capsys):
    """It is written once: what an artist may have put there is not replaced, and the sentence tells
    what helps."""
    root = copied / "room.usda"
    cut(root, root.stat().st_size // 2)
    for options in ((), ("--discard",)):
        command = ["convert", str(capture), "-o", str(copied), *COARSE, *options]
        assert main(command) == 3
        said = capsys.readouterr().err
        assert f"{root}: this is not a readable USD layer. Correct it, or remove it and run" in said
    root.unlink()
    convert(capture, copied)
    assert bytes_of(copied) == bytes_of(converted.folder)


def test_a_root_of_which_no_more_than_its_first_line_is_left_is_written_again(
    capture, converted, copied, capsys
):
    """Nobody's work is in it, and USD takes it for a stage: nothing else would be told."""
    root, whole = copied / "room.usda", (converted.folder / "room.usda").read_bytes()
    for rest in (b"#usda 1.0\n", b"#usda 1.0", b"#us", b"", bytes(512)):
        root.write_bytes(rest)
        assert is_cut(root)
    mend_root(Asset.at(copied))
    assert root.read_bytes() == whole
    root.write_bytes(b"#usda 1.0\n# the artist's\n")
    assert not is_cut(root)
    root.unlink()
    (copied / "theirs.usda").touch()
    root.symlink_to("theirs.usda")
    assert not is_cut(root)
    root.unlink()
    (copied / "theirs.usda").unlink()
    root.write_bytes(whole[:10])
    loud = [option for option in COARSE if option != "-q"]
    assert main(["convert", str(capture), "-o", str(copied), *loud]) == 0
    assert "room.usda: cut off; it is written again" in capsys.readouterr().err
    assert bytes_of(copied) == bytes_of(converted.folder)


@pytest.mark.parametrize("scan", ["damaged", "missing"])
def test_a_cut_root_is_made_again_with_its_scan(capture, converted, copied, scan):
    """Neither could be made again without the other. A step that makes neither leaves them."""
    (copied / "room.usda").write_bytes(b"#usda")
    if scan == "damaged":
        cut(copied / "layers/scan.usdc")
    else:
        (copied / "layers/scan.usdc").unlink()
    assert main(["texture", "-q", str(copied)]) != 0
    no_mesh = ["--mesh", str(capture / "objects.json")]
    assert main(["convert", str(capture), "-o", str(copied), *COARSE, *no_mesh]) != 0
    assert (copied / "room.usda").read_bytes() == b"#usda"
    convert(capture, copied)
    assert (copied / "room.usda").read_bytes() == (converted.folder / "room.usda").read_bytes()
    for part in PARTS:
        assert bytes_of(copied / part) == bytes_of(converted.folder / part)


def test_a_run_that_is_refused_leaves_a_cut_root_as_it_is(capture, copied):
    (copied / "room.usda").write_bytes(b"#usda 1.0\n")
    with (copied / "layers/material.usda").open("a") as layer:
        layer.write("# by hand\n")
    before = bytes_of(copied)
    assert main(["convert", str(capture), "-o", str(copied), *COARSE]) == 6
    assert bytes_of(copied) == before


def test_a_damaged_scan_is_made_again_with_other_options(capture, converted, copied):
    cut(copied / "layers/scan.usdc")
    convert(capture, copied, "--crease-angle", "60")
    assert main(["validate", str(copied)]) == 0
    convert(capture, copied)
    for part in PARTS:
        assert bytes_of(copied / part) == bytes_of(converted.folder / part)


@pytest.mark.parametrize("name", ["texturing.usda", "lights.usda", "material.usda"])
def test_a_text_layer_is_given_up_only_when_told_to(capture, converted, copied, name):
    """What looks damaged there may be an artist's slip."""
    cut(copied / "layers" / name, 100)
    call = ["convert", str(capture), "-o", str(copied), *COARSE]
    assert main(call) == 6
    assert main([*call, "--adopt"]) == 6
    assert main([*call, "--discard"]) == 0
    for part in PARTS:
        assert bytes_of(copied / part) == bytes_of(converted.folder / part)


def test_a_damaged_asset_in_a_renamed_folder_keeps_its_name(capture, copied):
    renamed = copied.rename(copied.with_name("lounge"))
    cut(renamed / "layers/scan.usdc")
    assert Asset.at(renamed).root_layer == renamed / "room.usda"
    convert(capture, renamed)
    assert [path.name for path in renamed.glob("*.usda")] in (
        ["room.usda", "edits.usda"],
        ["edits.usda", "room.usda"],
    )


def test_a_damaged_scan_is_named_where_it_cannot_be_made_again(copied, capfd):
    cut(copied / "layers/scan.usdc")
    assert main(["texture", str(copied), "--texel-size", "0.25"]) == 3
    assert "scan.usdc" in capfd.readouterr().err


def test_litter_in_the_capture_makes_nothing_run_again(base, converted, copied):
    capture = base / "scan"
    litter = [capture / ".DS_Store", capture / "frames" / "Thumbs.db", capture / "._mesh.ply"]
    before = {path: path.stat().st_ino for path in (copied / "layers").iterdir()}
    litter = [path for path in litter if path.parent.is_dir()]
    try:
        for path in litter:
            path.write_bytes(b"x")
        convert(capture, copied)
    finally:
        for path in litter:
            path.unlink(missing_ok=True)
    assert {path: path.stat().st_ino for path in (copied / "layers").iterdir()} == before
