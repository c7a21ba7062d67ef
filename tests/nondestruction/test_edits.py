"""What an artist says in edits.usda holds after every run, and no run listens to it."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pxr import Usd

from tests.nondestruction.artist import EXPECTED, IN_SHOT, edit, in_shot, read
from tests.nondestruction.conftest import COARSE, bytes_of, convert
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.asset.readers.compose import open_edited, open_measured
from usdbrdf.cli import main
from usdbrdf.job.progress import set_quiet

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


# Edits that USD cannot read, does not compose or crashes on

NESTED = 200_000
BROKEN = {
    "typing error": "#usda 1.0\nnot finished {",
    "missing sublayer": "#usda 1.0\n(\n    subLayers = [@./gone.usda@]\n)\n",
    "nested": "#usda 1.0\n" + 'over "a" {\n' * NESTED + "}\n" * NESTED,
}
RUNS = [("typing error", run) for run in RERUNS] + [(kind, "ingest") for kind in list(BROKEN)[1:]]


@pytest.fixture
def broken(edited, base):
    """A copy of the asset, as far from the capture as the others, with such edits."""
    made = []

    def with_edits(kind: str) -> Path:
        folder = base / f"broken_{len(made)}_{kind.replace(' ', '_')}" / "room"
        made.append(folder.parent)
        shutil.copytree(edited.folder, folder)
        (folder / "edits.usda").write_text(BROKEN[kind])
        return folder

    yield with_edits
    for folder in made:
        shutil.rmtree(folder)


@pytest.mark.fault("R9")
@pytest.mark.parametrize(("kind", "run"), RUNS)
def test_edits_that_cannot_be_read_change_nothing_of_what_is_measured(
    capture, run_again, broken, capsys, kind, run
):
    folder = broken(kind)
    set_quiet(False)
    options = [option for option in COARSE if option != "-q"] + RERUNS[run][0]
    assert main(["convert", str(capture), "-o", str(folder), *options]) == 0
    assert "warning: " in (said := capsys.readouterr().err)
    assert "edits.usda" in said
    assert (folder / "edits.usda").read_text() == BROKEN[kind]
    for part in ("layers", "textures", "previews"):
        assert bytes_of(folder / part) == bytes_of(run_again(run).folder / part)


@pytest.mark.parametrize("kind", BROKEN)
def test_what_needs_such_edits_says_so_in_a_sentence(broken, tmp_path, capfd, kind):
    folder = broken(kind)
    calls = {
        "validate": ["validate", str(folder)],
        "package": ["package", str(folder), "-o", str(tmp_path / "room.usdz")],
        "relight": ["relight", str(folder), "-o", str(tmp_path / "room.exr")],
    }
    for name, call in calls.items():
        expected = 7 if name == "validate" and kind != "nested" else 3
        assert main(call) == expected, (name, capfd.readouterr())
        out, err = capfd.readouterr()
        assert "edits.usda" in out + err
        assert "Traceback" not in out + err
    assert not list(tmp_path.iterdir())
