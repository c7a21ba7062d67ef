"""The recipes for other package systems name what is there."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from types import SimpleNamespace

import pytest

from usdbrdf.asset.schemas import plugin_path

ROOT = Path(__file__).resolve().parents[1]
REZ, CONTAINER = ROOT / "docs/packaging/rez", ROOT / "docs/packaging/Containerfile"
tomllib = pytest.importorskip("tomllib")  # part of Python from 3.11 on
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def rez() -> dict:
    made = {"env": SimpleNamespace()}
    exec((REZ / "package.py").read_text("utf-8"), made)
    return made


def test_rez_installs_this_checkout_with_its_constraints():
    package = rez()
    assert (package["name"], package["version"]) == (PROJECT["name"], PROJECT["version"])
    low, high = re.fullmatch(r">=([\d.]+),<([\d.]+)", PROJECT["requires-python"]).groups()
    assert package["requires"] == [f"python-{low}+<{high}"]
    assert package["tools"] == [*PROJECT["scripts"]]
    words = shlex.split(package["build_command"].format(root=REZ, install_path="/install"))
    constraints, checkout = (Path(word).resolve() for word in words[-2:])
    assert (constraints, checkout) == (ROOT / "constraints.txt", ROOT)
    assert constraints.is_file()


def test_rez_shows_usd_the_schemas():
    package, paths = rez(), {}
    for name in ("PATH", "PYTHONPATH", "PXR_PLUGINPATH_NAME"):
        setattr(package["env"], name, paths.setdefault(name, []))
    package["commands"]()
    site = paths["PYTHONPATH"][0]
    # Where a wheel has them: beside the modules.
    assert paths["PXR_PLUGINPATH_NAME"] == [f"{site}/usdbrdf/{plugin_path().name}"]
    assert paths["PATH"] == ["{root}/bin"]


def test_the_container_installs_extras_and_copies_what_there_is():
    text = CONTAINER.read_text("utf-8").replace("\\\n", " ")
    (extras,) = re.findall(r"/usr/src/usdbrdf\[([\w,]+)\]", text)
    assert {*extras.split(",")} <= PROJECT["optional-dependencies"].keys()
    named = set(re.findall(r"/usr/src/usdbrdf/([\w./]+)", text))
    assert named == {"constraints.txt", "samples/study"}
    ignored = (ROOT / ".dockerignore").read_text("utf-8").split()
    assert not {name.split("/")[0] for name in named} & {line.strip("/") for line in ignored}
