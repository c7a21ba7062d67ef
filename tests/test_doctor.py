"""What doctor says of this machine is so, and what is broken is told with the right status."""

from __future__ import annotations

import json
import os
import shutil
from email.message import Message
from importlib import metadata

import numpy as np
import psutil
import pytest

from usdbrdf import doctor
from usdbrdf.cli import main
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.relighting import render
from usdbrdf.transport.rays import Hits, RayScene


@pytest.fixture
def told(capsys):
    def ask() -> tuple[int, dict[str, dict[str, str]]]:
        status = main(["doctor", "--json"])
        document = json.loads(capsys.readouterr().out)
        assert document["works"] is (status == 0)
        return status, {found["name"]: found for found in document["findings"]}

    return ask


def test_this_machine_works(told, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    status, found = told()
    assert status == 0
    assert all(one["state"] == "ok" for one in found.values() if one["needed"])
    assert found["cores"]["text"].startswith(f"{len(os.sched_getaffinity(0))};")
    most = psutil.virtual_memory().total / 2**30
    assert 0 < float(found["memory"]["text"].split()[0]) <= most + 0.05
    free = shutil.disk_usage(tmp_path).free / 2**30
    assert float(found["disk"]["text"].split()[0]) == pytest.approx(free, abs=1)
    assert f"numpy {metadata.version('numpy')}" in found["libraries"]["text"]
    assert {"render", "denoise", "colmap", "report"} <= found.keys()
    assert not {"test", "dev", "docs"} & found.keys()


def test_lines_for_people(capsys):
    assert main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith(("ok ", "-- ", "BROKEN ")) for line in lines)


def test_an_extra_that_is_not_there_breaks_nothing(told, monkeypatch):
    known = Message()
    known["Provides-Extra"] = "raw"
    known["Requires-Dist"] = "numpy>=2"
    known["Requires-Dist"] = "numba>=0.61"
    known["Requires-Dist"] = "nowhere-to-be-had>=1; extra == 'raw'"
    known["Requires-Dist"] = "gone>=1; python_version < '3.2' and extra == 'raw'"
    monkeypatch.setattr(doctor, "_metadata_of_all", lambda: known)
    status, found = told()
    assert status == 0
    assert found["raw"]["state"] == "missing"
    cure = "nowhere-to-be-had not installed: pip install 'usdbrdf[raw]'"
    assert found["raw"]["text"] == cure


@pytest.mark.parametrize(
    ("package", "text"),
    [("mitsuba", "not used without Mitsuba"), ("pyoidn", "relight takes Mitsuba's slow way: ")],
)
def test_nothing_is_asked_for_that_would_be_of_no_use(monkeypatch, package, text):
    def not_there() -> None:
        raise EnvironmentFailure("not there")

    monkeypatch.setattr(render, "mitsuba_variant", not_there)
    version = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda name: None if name == package else version(name))
    (found,) = (one for one in doctor._programs() if one.name == "LLVM")
    assert found.state == "missing"
    assert found.text.startswith(text)


def test_rays_that_meet_the_wrong_thing_are_broken(told, monkeypatch):
    nothing = np.zeros(2, np.float32)
    wrong = Hits(np.array([-1, -1], np.int32), nothing, nothing, nothing)
    monkeypatch.setattr(RayScene, "closest", lambda *_: wrong)
    status, found = told()
    assert status == 4
    assert found["rays"]["state"] == "broken"
    assert "[-1, -1]" in found["rays"]["text"]


def test_a_library_that_is_missing_is_broken(told, monkeypatch):
    def without(package: str) -> str | None:
        return None if package == "xatlas" else "1"

    monkeypatch.setattr(doctor, "_version", without)
    status, found = told()
    assert status == 4
    assert found["libraries"]["text"].startswith("xatlas: not installed.")


@pytest.mark.parametrize(
    ("version", "asked", "within"),
    [
        ("2.0", ">=2.0,<3", True), ("2", "<3,>=2.0", True), ("2.4.1", ">=2,<3", True),
        ("1.26.4", ">=2.0,<3", False), ("3.0", ">=2.0,<3", False), ("10.1", ">=9.2,<11", True),
        ("2.0.0rc1", ">=2.0,<3", True), ("2023.12.post3", ">=2023.12,<2027", True),
        ("0.0.8", ">=0.0.9,<0.1", False), ("7", "", True),
    ],
)  # fmt: skip
def test_a_version_lies_between_its_bounds(version, asked, within):
    assert doctor._is_within(version, asked) is within


def test_other_versions_than_those_asked_for_are_told(told, monkeypatch):
    known = Message()
    known["Provides-Extra"] = "report"
    for line in (
        "numpy<3,>=2.0", "numba>=0.61", "scipy (>=1.13,<2)",
        "matplotlib<4,>=3.9; extra == 'report'", "moto[s3]>=5; extra == 'report'",
    ):  # fmt: skip
        known["Requires-Dist"] = line
    versions = {"numpy": "2.2", "scipy": "1.14", "matplotlib": "3.8.4", "moto": "5.0"}
    monkeypatch.setattr(doctor, "_metadata_of_all", lambda: known)
    monkeypatch.setattr(doctor, "_version", lambda name: versions.get(name, "1"))
    status, found = told()
    assert status == 0
    assert found["report"]["state"] == "broken"
    assert found["report"]["text"] == (
        "matplotlib is 3.8.4, not <4,>=3.9: pip install 'usdbrdf[report]'"
    )
    versions["scipy"] = "2.1"
    status, found = told()
    assert status == 4
    assert found["libraries"]["state"] == "broken"
    assert found["libraries"]["text"].startswith("scipy is 2.1, not >=1.13,<2. Install")
