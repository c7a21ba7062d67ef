"""Assets from strangers: layers that USD crashes on wherever they lie, and what is no file."""

from __future__ import annotations

import os
import shutil

import pytest

from tests.nondestruction.conftest import COARSE, bytes_of
from usdbrdf.asset.advice import read_advice
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused

NESTED = "#usda 1.0\n" + 'over "a" {\n' * 200_000 + "}\n" * 200_000
COMPONENT = "objects/box/box.usda"


@pytest.fixture
def strange(base, converted, request):
    """A copy of the asset, as far from the capture as before; nobody can tell what wrote it."""
    folder = base / f"strange-{abs(hash(request.node.name))}" / "room"
    shutil.copytree(converted.folder, folder)
    for stamp in (folder / ".usdbrdf/stamps").iterdir():
        stamp.unlink()
    yield folder
    shutil.rmtree(folder.parent)


def calls(folder, other, out):
    texels = ["--texel-size", "0.3"]
    return {
        "texture": ["texture", str(folder), *texels],
        "shade": ["shade", str(folder)],
        "fit": ["fit", str(folder)],
        "adopt": ["convert", str(other), "-o", str(folder), "--adopt"],
        "advise": ["advise", str(folder)],
        "compare": ["compare", str(folder), str(other), "-o", str(out / "compared")],
        "package": ["package", str(folder), "-o", str(out / "room.usdz")],
        "whole": ["package", str(folder), "-o", str(out / "room.usdz"), "--whole"],
        "publish": ["publish", str(folder), str(out / "versions")],
        "relight": ["relight", str(folder), "-o", str(out / "lit.exr")],
        "validate": ["validate", str(folder)],
    }


@pytest.mark.fault("S3")
@pytest.mark.parametrize(
    ("name", "layer"),
    [
        ("texture", "layers/scan.interface.usda"),
        ("shade", "layers/texturing.usda"),
        ("fit", "layers/shading.usda"),
        ("advise", "layers/material.usda"),
        ("compare", "layers/material.usda"),
        ("package", "layers/material.usda"),
        ("whole", COMPONENT),
        ("publish", COMPONENT),
    ],
)
def test_a_layer_that_usd_crashes_on_is_refused_whoever_reads_it(
    converted, strange, tmp_path, capfd, name, layer
):
    (strange / layer).write_text(NESTED)
    before = bytes_of(strange)
    assert main(calls(strange, converted.folder, tmp_path)[name]) == 3
    said = capfd.readouterr().err
    assert "(SIGSEGV)" in said
    assert str(strange) in said
    assert bytes_of(strange) == before
    assert not list(tmp_path.iterdir())


@pytest.mark.fault("S3")
def test_advice_that_usd_crashes_on_is_none(strange):
    asset = Asset.at(strange)
    asset.advice_layer.write_text(NESTED)
    with pytest.raises(InputRefused, match="not the advice"):
        read_advice(asset)


@pytest.mark.fault("S3")
def test_an_edit_that_usd_crashes_on_is_not_adopted(capture, base, converted, capfd):
    folder = base / "nested-edit" / "room"
    shutil.copytree(converted.folder, folder)
    (folder / "layers/material.usda").write_text(NESTED)
    assert main(["convert", str(capture), "-o", str(folder), *COARSE, "--adopt"]) == 6
    assert "material.usda" in capfd.readouterr().err
    assert not list(folder.glob("adopted-*"))


@pytest.mark.fault("I13")
@pytest.mark.parametrize("layer", ["edits.usda", "layers/lights.usda", COMPONENT])
@pytest.mark.parametrize("name", ["package", "publish", "validate"])
def test_a_pipe_among_the_layers_is_not_waited_for(
    converted, strange, tmp_path, capfd, name, layer
):
    (strange / layer).unlink()
    os.mkfifo(strange / layer)
    assert main(calls(strange, converted.folder, tmp_path)[name]) == 3
    assert f"{strange / layer}: this is no regular file" in capfd.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.fault("I13")
@pytest.mark.parametrize("template", [False, True])
def test_a_pipe_among_value_clips_is_not_waited_for(converted, strange, tmp_path, capfd, template):
    pipe = strange.parent / "clips" / "c.1.usda"
    pipe.parent.mkdir()
    os.mkfifo(pipe)
    where = (
        'string templateAssetPath = "../clips/c.#.usda"\ndouble templateStartTime = 1\n'
        "double templateEndTime = 1\ndouble templateStride = 1\n"
        if template
        else "asset[] assetPaths = [@../clips/c.1.usda@]\ndouble2[] active = [(0, 0)]\n"
    )
    clips = f'clips = {{\ndictionary default = {{\n{where}string primPath = "/room"\n}}\n}}'
    (strange / "edits.usda").write_text(f'#usda 1.0\nover "room" (\n{clips}\n)\n{{\n}}\n')
    try:
        assert main(calls(strange, converted.folder, tmp_path)["validate"]) == 3
    finally:
        pipe.unlink()
        pipe.parent.rmdir()
    assert f"{pipe}: this is no regular file" in capfd.readouterr().err


@pytest.mark.fault("I13")
@pytest.mark.parametrize("name", ["package", "validate"])
def test_a_pipe_that_the_edits_name_elsewhere_is_not_waited_for(
    converted, strange, tmp_path, capfd, name
):
    calls_of_it = calls(strange, converted.folder, tmp_path)[name]
    pipe, between = strange.parent / "pipe.usda", strange.parent / "between.usda"
    os.mkfifo(pipe)
    between.write_text('#usda 1.0\nover "x" (references = @pipe.usda@) {}\n')
    names = "@../none.usda@, @../between.usda@"
    (strange / "edits.usda").write_text(f"#usda 1.0\n(\n    subLayers = [{names}]\n)\n")
    try:
        assert main(calls_of_it) == 3
    finally:
        pipe.unlink()
        between.unlink()
    assert f"{pipe}: this is no regular file" in capfd.readouterr().err


@pytest.mark.fault("I13")
def test_a_pipe_in_the_place_of_the_edits_stops_no_measurement(capture, base, converted, capfd):
    folder = base / "pipe" / "room"
    shutil.copytree(converted.folder, folder)
    (folder / "edits.usda").unlink()
    os.mkfifo(folder / "edits.usda")
    told = [option for option in COARSE if option != "-q"]
    assert main(["convert", str(capture), "-o", str(folder), *told, "--seed", "1"]) == 0
    assert "edits.usda: this is no regular file" in capfd.readouterr().err
    assert (folder / "edits.usda").is_fifo()


@pytest.mark.fault("R7")
@pytest.mark.parametrize("content", [b"", b"PXR-USDC", b"no layer at all"])
def test_damage_to_where_the_photographs_are_is_a_finding(strange, capsys, content):
    (strange / "layers/photographs.usdc").write_bytes(content)
    assert main(["validate", str(strange)]) == 0
    assert "photographs.usdc@ cannot be read" in capsys.readouterr().out


@pytest.mark.fault("R7")
@pytest.mark.parametrize("content", [b"", b"PXR-USDC", b"no layer at all"])
@pytest.mark.parametrize(
    ("name", "layer"),
    [
        ("texture", "layers/photographs.usdc"),
        ("relight", "layers/photographs.usdc"),
        ("fit", "layers/lights.usda"),
    ],
)
def test_a_layer_that_cannot_be_read_is_named(
    converted, strange, tmp_path, capfd, name, layer, content
):
    """And not the stage that a step makes of all of them."""
    (strange / layer).write_bytes(content)
    assert main(calls(strange, converted.folder, tmp_path)[name]) == 3
    said = capfd.readouterr().err
    assert f"{strange / layer}: this is not a readable USD layer" in said
    assert "anon:" not in said


@pytest.mark.fault("R7")
@pytest.mark.parametrize("layer", ["layers/contents.usda", "room.usda", COMPONENT])
@pytest.mark.parametrize("name", ["texture", "shade", "fit"])
def test_a_step_in_an_asset_that_lost_a_layer_is_refused_before_its_work(
    base, converted, tmp_path, capfd, layer, name, request
):
    folder = base / f"lost-{abs(hash(request.node.name))}" / "room"
    shutil.copytree(converted.folder, folder)
    (folder / layer).unlink()
    before = bytes_of(folder)
    call = calls(folder, converted.folder, tmp_path)[name]
    assert main([*call, "--seed", "9"] if name != "texture" else call) == 3
    assert f"{folder / layer}: this layer of the asset is missing" in capfd.readouterr().err
    assert bytes_of(folder) == before
    shutil.rmtree(folder.parent)
