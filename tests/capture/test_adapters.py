"""Adapters of other packages: found, listed, and never fatal."""

from __future__ import annotations

import types
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from tests.scenes import make_capture
from usdbrdf.capture import adapters
from usdbrdf.capture.adapters import list_adapters, read_scan
from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.options import IngestOptions


@pytest.fixture
def announce(monkeypatch):
    """Pretend that packages announce these objects; an exception stands for a failing import."""

    def install(**modules):
        def load(point):
            found = modules[point.name]
            if isinstance(found, BaseException):
                raise found
            return found

        points = tuple(EntryPoint(name, f"pkg.{name}", adapters.GROUP) for name in modules)
        monkeypatch.setattr(adapters, "entry_points", lambda group: points)
        monkeypatch.setattr(EntryPoint, "load", load)

    return install


def _adapter(**members):
    return types.SimpleNamespace(
        **{
            "NAME": "theirs",
            "DESCRIPTION": "their format",
            "matches": lambda path: path.name == "theirs",
            "read": lambda path, options: ("read by theirs", path, options),
            **members,
        }
    )


def test_ours_are_there_even_if_nothing_is_installed(announce):
    announce()
    assert [a.name for a in list_adapters()] == ["transforms", "scanner-app"]
    assert all(a.module is not None and a.description for a in list_adapters())


def test_ours_are_announced_in_the_same_way():
    tomllib = pytest.importorskip("tomllib")  # part of Python from 3.11 on
    project = tomllib.loads((Path(adapters.__file__).parents[2] / "pyproject.toml").read_text())
    assert project["project"]["entry-points"][adapters.GROUP] == adapters.MODULES


def test_theirs_is_found_and_used(announce, tmp_path):
    announce(theirs=_adapter())
    (tmp_path / "theirs").mkdir()
    options = IngestOptions()
    assert read_scan(tmp_path / "theirs", options)[0] == "read by theirs"
    assert read_scan(tmp_path, options, "theirs")[0] == "read by theirs"
    assert [a.name for a in list_adapters(plugins=False)] == ["transforms", "scanner-app"]


@pytest.mark.parametrize(
    ("module", "problem"),
    [
        (ImportError("no module named moon"), "ImportError: no module named moon"),
        (SystemExit(3), "SystemExit: 3"),
        (_adapter(read=None), "it has no read"),
        (_adapter(NAME=5, matches=1), "it has no NAME, matches"),
    ],
)
def test_a_broken_one_is_reported_listed_and_skipped(announce, tmp_path, capsys, module, problem):
    announce(theirs=module)
    capture = make_capture(tmp_path / "room")
    assert read_scan(capture.folder, IngestOptions()).adapter == "transforms"
    assert f"'theirs' (pkg.theirs) is skipped: {problem}" in capsys.readouterr().err
    broken = list_adapters()[-1]
    assert (broken.name, broken.module, broken.problem) == ("theirs", None, problem)
    with pytest.raises(UsageError, match=r"'theirs' is broken"):
        read_scan(capture.folder, IngestOptions(), "theirs")


def test_one_that_fails_while_it_looks_or_reads_does_not_stop_us(announce, tmp_path, capsys):
    def explode(*_):
        raise RuntimeError("boom")

    announce(a=_adapter(matches=explode), theirs=_adapter(read=explode))
    (tmp_path / "theirs").mkdir()
    with pytest.raises(InputRefused, match=r"adapter 'theirs' \(pkg.theirs\) failed: .*boom"):
        read_scan(tmp_path / "theirs", IngestOptions())
    assert "adapter 'a' is skipped" in capsys.readouterr().err


def test_ours_cannot_be_replaced(announce):
    announce(transforms=_adapter())
    assert [a.origin for a in list_adapters()] == list(adapters.MODULES.values())


def test_nothing_recognised_lists_what_would_be(tmp_path):
    with pytest.raises(InputRefused, match=r"transforms: .*scanner-app: .*\[adapter.none\]"):
        read_scan(tmp_path, IngestOptions())
    with pytest.raises(InputRefused, match=r"no such file.*\[capture.missing\]"):
        read_scan(tmp_path / "nowhere", IngestOptions())
    with pytest.raises(UsageError, match=r"'colmap' is not installed. Use one of transforms"):
        read_scan(tmp_path, IngestOptions(), "colmap")


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
