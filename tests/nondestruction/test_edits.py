"""What an artist says in edits.usda holds after every run, and no run listens to it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pxr import Usd

from tests.nondestruction.artist import EXPECTED, IN_SHOT, edit, in_shot, read
from tests.nondestruction.conftest import bytes_of, convert
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import open_edited, open_measured

# Options that differ from the first run's, and the layers that come out otherwise because of them.
RERUNS = {
    "ingest": (["--crease-angle", "60"], set(ROLES)),
    "seed": (["--seed", "7"], {"shading", "material"}),
    "texel size": (["--texel-size", "0.25"], {"texturing", "shading", "material"}),
    "fit": (["--fit", "paper"], {"material"}),
    "mapping": (["--material", "measured"], {"material"}),
}


@pytest.fixture(scope="module")
def edited(base, converted):
    """The asset with all edits, to be copied."""
    folder = base / "edited" / "room"
    shutil.copytree(converted.folder, folder)
    asset = Asset.at(folder)
    edit(asset)
    return asset


@pytest.fixture(scope="module")
def run_again(base, capture, edited):
    """The edited asset after a run with other options; each is made once."""
    made: dict[str, Asset] = {}

    def again(name: str) -> Asset:
        if name not in made:
            folder = base / name.replace(" ", "_") / "room"
            shutil.copytree(edited.folder, folder)
            made[name] = convert(capture, folder, *RERUNS[name][0])
        return made[name]

    return again


def changed_layers(before: Path, after: Path) -> set[str]:
    old, new = (bytes_of(folder / "layers") for folder in (before, after))
    return {name.split(".")[0] for name in old if old[name] != new[name]} & set(ROLES)


def test_everything_that_is_edited_was_measured_otherwise(edited):
    """Else what follows would prove nothing."""
    measured = read(open_measured(edited))
    # Looks that a binding was not made in, and names that were not there, stay as they are.
    alike = {"binding in a look, albedo"}
    assert {name for name in EXPECTED if measured[name] == EXPECTED[name]} == alike
    assert read(open_edited(edited)) == EXPECTED


@pytest.mark.parametrize("name", RERUNS)
def test_edits_hold_after_a_run_with_other_options(edited, run_again, name):
    asset = run_again(name)
    assert changed_layers(edited.folder, asset.folder) == RERUNS[name][1]
    assert asset.edits_layer.read_bytes() == edited.edits_layer.read_bytes()
    assert asset.root_layer.read_bytes() == edited.root_layer.read_bytes()
    assert bytes_of(asset.folder / "mine") == bytes_of(edited.folder / "mine")
    assert read(open_edited(asset)) == EXPECTED
    assert in_shot(asset) == IN_SHOT


def test_no_run_listens_to_the_artist(base, capture, converted, run_again):
    """Ingest: every step runs anew, below edits that move, hide, remove and recolour things;
    without them the same files come out, byte for byte."""
    folder = base / "untouched" / "room"
    shutil.copytree(converted.folder, folder)
    untouched = convert(capture, folder, *RERUNS["ingest"][0])
    asset = run_again("ingest")
    for part in ("layers", "textures", "previews"):
        assert bytes_of(asset.folder / part) == bytes_of(untouched.folder / part)


@pytest.mark.parametrize("name", ["seed", "texel size"])
def test_a_muted_layer_is_muted_for_the_edits_too(edited, run_again, name):
    """Muting is a session's: what is muted is gone from it, and nothing from the files."""
    asset = run_again(name)
    for role in ("material", "shading"):
        stage = Usd.Stage.Open(str(asset.root_layer))
        stage.MuteLayer(str(asset.layer(role)))
        assert not stage.GetCompositionErrors()
        shown = read(stage)
        kept = ("roughness", "ior", "moved", "deactivated", "hidden", "display name", "look")
        assert {key: shown[key] for key in kept} == {key: EXPECTED[key] for key in kept}
    stage = Usd.Stage.Open(str(asset.root_layer))
    stage.MuteLayer(str(asset.edits_layer))
    assert read(stage) == read(open_measured(asset))


def test_an_asset_whose_edits_cannot_be_read_is_still_measured(edited, capture, base):
    """The pipeline does not open edits.usda at all."""
    folder = base / "broken" / "room"
    shutil.copytree(edited.folder, folder)
    edits = folder / "edits.usda"
    edits.write_text("#usda 1.0\nnot finished {")
    asset = convert(capture, folder, "--fit", "paper")
    assert edits.read_text() == "#usda 1.0\nnot finished {"
    assert changed_layers(edited.folder, asset.folder) == {"material"}
