"""Adapters of other packages: found, listed, and never fatal."""

from __future__ import annotations

import os
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from tests.scenes import make_capture
from usdbrdf.capture import adapters
from usdbrdf.capture.adapters import choose_adapter, list_adapters, read_scan
from usdbrdf.cli import main
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted import bounds


@pytest.fixture
def announce(monkeypatch, tmp_path):
    """Pretend that a package announces these modules, of which the source is given."""
    package = tmp_path / "on_path" / "pkg"

    def install(**sources):
        package.mkdir(parents=True)
        for name, source in sources.items():
            (package / f"{name}.py").write_text(source)
        monkeypatch.syspath_prepend(str(package.parent))
        points = tuple(EntryPoint(name, f"pkg.{name}", adapters.GROUP) for name in sources)
        monkeypatch.setattr(adapters, "entry_points", lambda group: points)

    yield install
    for name in [name for name in sys.modules if name.partition(".")[0] == "pkg"]:
        del sys.modules[name]


_THEIRS = """
from usdbrdf.model.capture import Scan

NAME = "theirs"
DESCRIPTION = "their format"

def matches(path):
    return path.name == "theirs"

def read(path, options):
    scan = object.__new__(Scan)
    object.__setattr__(scan, "name", "read by theirs")
    return scan

def explode(*_):
    raise RuntimeError("boom")
"""


def test_ours_are_there_even_if_nothing_is_installed(announce):
    announce()
    assert (
        [a.name for a in list_adapters()] == list(adapters.MODULES) == list(adapters.DESCRIPTIONS)
    )
    assert all(a.module is not None and a.description for a in list_adapters())


def test_ours_are_announced_in_the_same_way():
    tomllib = pytest.importorskip("tomllib")  # part of Python from 3.11 on
    project = tomllib.loads((Path(adapters.__file__).parents[2] / "pyproject.toml").read_text())
    assert project["project"]["entry-points"][adapters.GROUP] == adapters.MODULES


def test_theirs_is_found_and_used(announce, tmp_path):
    announce(theirs=_THEIRS)
    (tmp_path / "theirs").mkdir()
    options = IngestOptions()
    assert read_scan(tmp_path / "theirs", options).name == "read by theirs"
    assert read_scan(tmp_path, options, "theirs").name == "read by theirs"
    assert [a.name for a in list_adapters(plugins=False)] == list(adapters.MODULES)


def test_theirs_come_before_those_of_ours_that_claim_much(announce, tmp_path):
    """A trajectory, or one USD stage, says little of whose format a folder is."""
    announce(theirs=_THEIRS)
    trajectory = '{"class_name": "PinholeCameraTrajectory"}'
    for name, said in (("a.json", trajectory), ("room.usda", "#usda 1.0"), ("a.abc", "Ogawa")):
        for folder in (tmp_path / name / "theirs", tmp_path / name / "ours"):
            folder.mkdir(parents=True)
            (folder / name).write_text(said)
            chosen = choose_adapter(folder).name
            assert (chosen == "theirs") == (folder.name == "theirs")
        (folder.parent / "theirs/transforms.json").write_text("{}")
        assert choose_adapter(folder.parent / "theirs").name == "transforms"


@pytest.mark.fault("S6")
@pytest.mark.parametrize(
    ("source", "problem"),
    [
        ("raise ImportError('no module named moon')", "ImportError: no module named moon"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        (_THEIRS + "read = None", "it has no read"),
        (_THEIRS + "NAME = 5; matches = 1", "it has no NAME, matches"),
        (
            "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
            "its import crashed (SIGSEGV). Repair the input",
        ),
    ],
)
def test_a_broken_one_is_reported_listed_and_skipped(announce, tmp_path, capsys, source, problem):
    announce(theirs=source)
    capture = make_capture(tmp_path / "room")
    assert read_scan(capture.folder, IngestOptions()).adapter == "transforms"
    assert f"'theirs' (pkg.theirs) is skipped: {problem}" in capsys.readouterr().err
    broken = list_adapters()[-1]
    assert (broken.name, broken.module, broken.problem) == ("theirs", None, problem)
    with pytest.raises(UsageError, match=r"'theirs' is broken"):
        read_scan(capture.folder, IngestOptions(), "theirs")


@pytest.mark.fault("S6")
def test_one_that_hangs_at_import_is_reported_and_skipped(announce, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(bounds, "PLUGIN_SECONDS", 5.0)
    announce(theirs="while True: pass")
    capture = make_capture(tmp_path / "room")
    assert read_scan(capture.folder, IngestOptions()).adapter == "transforms"
    expected = "'theirs' (pkg.theirs) is skipped: its import did not end within 5 s"
    assert expected in capsys.readouterr().err


def test_a_capture_that_usd_cannot_name_is_refused(tmp_path):
    folder = make_capture(tmp_path / "room").folder
    folder = folder.rename(tmp_path / os.fsdecode(b"\xff"))
    with pytest.raises(InputRefused, match=r"not UTF-8.*\[paths\.name\]$"):
        read_scan(folder, IngestOptions())


def test_one_that_fails_while_it_looks_or_reads_does_not_stop_us(announce, tmp_path, capsys):
    announce(a=_THEIRS + "matches = explode", theirs=_THEIRS + "read = explode")
    (tmp_path / "theirs").mkdir()
    with pytest.raises(InputRefused, match=r"adapter 'theirs' \(pkg.theirs\) failed: .*boom"):
        read_scan(tmp_path / "theirs", IngestOptions())
    assert "adapter 'a' is skipped" in capsys.readouterr().err


def test_ours_cannot_be_replaced(announce):
    announce(transforms=_THEIRS)
    assert [a.origin for a in list_adapters()] == list(adapters.MODULES.values())


_STRAY = [
    ("block.xml", "<BlocksExchange>", "blocks-exchange"),
    ("a_parameters.txt", "fileName imageWidth imageHeight", "pix4d"),
    ("bundle.out", "# Bundle file v0.3", "bundler"),
    ("a.nvm", "NVM_V3", "visualsfm"),
    ("a.json", '{"class_name": "PinholeCameraTrajectory"}', "rgbd-scan"),
]


@pytest.mark.parametrize(("stray", "said", "theirs"), _STRAY)
@pytest.mark.parametrize(("own", "adapter"), [("poses_bounds.npy", "llff"), ("room.e57", "e57")])
def test_what_other_programs_leave_in_a_capture_does_not_stand_for_it(
    tmp_path, stray, said, theirs, own, adapter
):
    """Its cameras are those that another format was made from, or of an attempt."""
    (tmp_path / stray).write_text(said)
    assert choose_adapter(tmp_path).name == theirs
    (tmp_path / own).write_bytes(b"")
    assert choose_adapter(tmp_path).name == adapter
    assert choose_adapter(tmp_path / stray).name == theirs


@pytest.mark.parametrize(("stray", "said", "theirs"), _STRAY)
def test_a_mesh_in_usd_beside_a_programs_cameras_is_no_stage_of_photographs(
    tmp_path, stray, said, theirs
):
    (tmp_path / stray).write_text(said)
    (tmp_path / "mesh.usda").write_text("#usda 1.0")
    assert choose_adapter(tmp_path).name == theirs
    assert choose_adapter(tmp_path / "mesh.usda").name == "usd"


def test_nothing_recognised_says_so_in_a_sentence(tmp_path):
    (tmp_path / "notes.txt").write_text("of no capture")
    known = r"it holds neither pictures nor cameras.*`usdbrdf adapters`.*\[adapter.none\]$"
    with pytest.raises(InputRefused, match=known) as refusal:
        read_scan(tmp_path, IngestOptions())
    assert len(str(refusal.value).replace(str(tmp_path), "")) < 250
    with pytest.raises(InputRefused, match=r"no such file.*\[capture.missing\]"):
        read_scan(tmp_path / "nowhere", IngestOptions())
    with pytest.raises(UsageError, match=r"'nonesuch' is not installed. Use one of eyeful-tower"):
        read_scan(tmp_path, IngestOptions(), "nonesuch")


def test_a_pipe_is_no_capture_whatever_it_is_called(tmp_path):
    """It was told as a full disk."""
    os.mkfifo(tmp_path / "transforms.json")
    with pytest.raises(InputRefused, match=r"neither a regular file nor.*\[capture\.missing\]$"):
        read_scan(tmp_path / "transforms.json", IngestOptions())


@pytest.mark.parametrize(
    "options",
    [
        {"crease_angle_deg": -1},
        {"decimate": 0},
        {"max_nonfinite": 1.5},
        {"pose_scale": 0},
        {"meters_per_unit": float("nan")},
    ],
)
def test_options_out_of_range_are_usage_errors(options):
    with pytest.raises(UsageError, match=r"\[usage.option\]$"):
        IngestOptions(**options)


@pytest.mark.fault("S6")
@pytest.mark.parametrize("signature", ["path", "path, options, more", "*, path"])
def test_one_made_for_another_version_of_ours_fails_in_a_sentence(announce, tmp_path, signature):
    announce(theirs=f"{_THEIRS}\ndef read({signature}):\n    return None\n")
    (tmp_path / "theirs").mkdir()
    with pytest.raises(InputRefused, match=r"'theirs' \(pkg.theirs\) failed: TypeError.*authors"):
        read_scan(tmp_path / "theirs", IngestOptions())


@pytest.mark.fault("S6")
def test_one_that_returns_no_scan_fails_in_a_sentence(announce, tmp_path, capsys):
    announce(theirs=f"{_THEIRS}\ndef read(path, options):\n    return {{'frames': []}}\n")
    (tmp_path / "theirs").mkdir()
    assert main(["ingest", str(tmp_path / "theirs"), "-o", str(tmp_path / "out"), "-q"]) == 3
    said = capsys.readouterr().err
    assert "'theirs' (pkg.theirs) failed: TypeError('it returned a dict in the place" in said
    assert not (tmp_path / "out").exists()
