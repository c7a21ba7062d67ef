"""Into a published version nothing is written, whichever command is asked to and by which option.

The commands and their paths are those of the parser: one that is new is refused here too, or stands
below as one that is read."""

from __future__ import annotations

import json
import shutil
import typing
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.synthetic_asset import build, make_scan
from usdbrdf.cli import main
from usdbrdf.commands import COMMANDS
from usdbrdf.errors import OwnershipConflict
from usdbrdf.job.versions import refuse_version, version_around
from usdbrdf.option import REQUIRED, option_fields

# What is read alone.
READ = {
    *("SCAN", "OTHER", "--mesh", "--objects", "--frames", "--allow-outside", "--environment"),
    *("--views", "--other-views", "--truth", "--lights", "--evaluation", "--list", "--root"),
}
READERS = {
    *("evaluate", "compare", "paper", "relight", "package", "publish", "report", "view"),
    "validate",
}
SUFFIX = {"relight": ".exr", "package": ".usdz", "report": ".html", "validate": ".usda"}


def options_of(owner):
    for field in option_fields(owner):
        if field.option is None:
            yield from options_of(field.kind)
        else:
            yield field


def is_path(field):
    return Path in (field.kind, *typing.get_args(field.kind))


WRITTEN = [
    (command, field.option.name)
    for command, owner in COMMANDS.items()
    for field in options_of(owner)
    if is_path(field) and field.option.name not in READ
    if not (field.option.name == "ASSET" and command in READERS)
]


@pytest.fixture(scope="module")
def asset(tmp_path_factory):
    top = tmp_path_factory.mktemp("whole")
    return build(top / "room", make_scan(top / "capture")).asset.folder


@pytest.fixture
def places(tmp_path, asset):
    """An asset, and a capture, a version and bundles with no more in them than asked for before
    the refusal."""
    capture, version = tmp_path / "capture", tmp_path / "versions/v001"
    for folder in (capture, version / "layers"):
        folder.mkdir(parents=True)
    (capture / "transforms.json").write_text('{"frames": []}')
    (version / "v001.usd").write_text("#usda 1.0\n")
    (version / "manifest.json").write_text('{"schema": 1, "check": "", "files": {}}')
    scans = {"schema": 1, "root": str(tmp_path), "scans": [{"name": "a", "place": "capture"}]}
    for bundle in (tmp_path / "bundle", version / "bundle"):
        bundle.mkdir()
        (bundle / "scans.json").write_text(json.dumps(scans))
    return SimpleNamespace(asset=asset, capture=capture, version=version, top=tmp_path)


def tree_of(folder):
    return {
        str(file.relative_to(folder)): file.read_bytes() if file.is_file() else None
        for file in folder.rglob("*")
    }


def words_for(command, option, places, place):
    """A command line with what it must have, and with this place for the option."""
    given = {
        "SCAN": places.capture, "OTHER": places.asset,
        "ASSET": places.asset if command in READERS else places.top / "room",
        "BUNDLE": places.top / "bundle", "DEST": places.top / "new",
        "--output": places.top / f"new{SUFFIX.get(command, '')}",
        "--views": places.capture / "transforms.json",
    }  # fmt: skip
    fields = {field.option.name: field for field in options_of(COMMANDS[command])}
    asked = {
        name: str(given[name])
        for name, field in fields.items()
        if field.default is REQUIRED or name == "SCAN"
    } | {option: str(place)}
    placed = [word for name, word in asked.items() if fields[name].option.placed]
    named = [f"{name}={word}" for name, word in asked.items() if not fields[name].option.placed]
    return [command, *placed, *named]


@pytest.mark.fault("R18")
@pytest.mark.parametrize(("command", "option"), WRITTEN)
def test_no_command_writes_into_a_version(places, capsys, command, option):
    more = []
    if option == "--shared-folder":
        pytest.importorskip("distributed", reason="needs usdbrdf[cluster]")
        more = ["--workers=2"]
    own = {"ASSET": places.version, "BUNDLE": places.version / "bundle"}
    place = own.get(option, places.version / f"new{SUFFIX.get(command, '')}")
    before = tree_of(places.top)
    assert main([*words_for(command, option, places, place), *more]) == 6
    said = capsys.readouterr().err
    assert "is a published version, which never changes" in said
    assert said.endswith("[ownership.published]\n")
    assert tree_of(places.top) == before


def test_every_command_that_writes_is_among_them():
    written = {command for command, _ in WRITTEN}
    assert set(COMMANDS) - written == {
        *("inspect", "view", "rules", "adapters", "doctor", "completion", "plugin-path")
    }


@pytest.mark.fault("R18")
@pytest.mark.parametrize("lost", ["", "manifest.json", "v001.usd"])
@pytest.mark.parametrize("name", ["v001", "renamed"])
def test_a_version_that_was_renamed_or_lost_a_file_is_one_still(places, name, lost):
    (places.version / "layers/scan.usdc").touch()
    folder = places.version.rename(places.top / name)
    (folder / (lost or ".DS_Store")).unlink(missing_ok=True)
    for place in (folder, folder / "layers/new"):
        assert version_around(place) == folder
        with pytest.raises(
            OwnershipConflict, match=r"published version.*\[ownership\.published\]$"
        ):
            refuse_version(place)
    assert version_around(places.top) is None


def test_an_asset_with_a_usd_file_beside_its_own_is_no_version(places):
    folder = shutil.copytree(places.asset, places.top / "room")
    (folder / "flat.usd").touch()
    refuse_version(folder / "fixes.usda")
    shots = places.top / "v012"
    shots.mkdir()
    (shots / "manifest.json").touch()  # of another program's folder of versions
    refuse_version(shots / "new")
    (places.capture / "capture.usd").touch()
    refuse_version(places.capture / "new")
