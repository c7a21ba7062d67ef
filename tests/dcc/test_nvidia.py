"""usd-validation-nvidia, an application of others, runs our rules and finds what they find."""

import csv
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.validation.faults import FAULTS
from usdbrdf.asset.schemas import plugin_path
from usdbrdf.validation.validate import RULES

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("usd_validation_nvidia") is None,
    reason="usd-validation-nvidia is not installed (extra dcc)",
)
ROOT = Path(__file__).resolve().parents[2]


# Its command checks stages in one thread while it switches their variants in another, from which it
# crashes now and then. Its engine, called like this, does all in one.
_ENGINE = """
import sys
from usd_validation_nvidia import ValidationEngine
engine = ValidationEngine(variants=len(sys.argv) < 3)
found = [str(issue) for issue in engine.validate(sys.argv[1]).issues()]
sys.exit("\\n".join(found) or 0)
"""


@pytest.fixture
def run(tmp_path):
    """The command, in an environment where the package is installed as pyproject.toml says."""
    group = "usd_validation_nvidia"
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (entry,) = re.findall(rf'^\[project.entry-points.{group}\]\nusdbrdf = "(.+)"$', project, re.M)
    info = tmp_path / "installed" / "usdbrdf-0.0.dist-info"
    info.mkdir(parents=True)
    (info / "entry_points.txt").write_text(f"[{group}]\nusdbrdf = {entry}\n")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: usdbrdf\nVersion: 0.0\n")

    def command(*arguments, schemas="", program=("-m", "usd_validation_nvidia")):
        path = os.pathsep.join([str(info.parent), str(ROOT)])
        return subprocess.run(
            [sys.executable, *program, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": path, "PXR_PLUGINPATH_NAME": schemas},
            capture_output=True,
            text=True,
        )

    return command


def test_it_explains_all_our_rules(run):
    done = run("--category", "usdbrdf", "--explain", "x.usda")
    assert done.returncode == 0, done.stderr
    for rule in RULES:
        assert f"UsdBrdf{rule.name} : {rule.description}" in done.stdout


@pytest.mark.parametrize("schemas", ["", "known"])
def test_it_finds_nothing_in_a_sound_asset(run, built, schemas):
    known = str(plugin_path()) if schemas else ""
    done = run("--no-variants", built.asset.root_layer, schemas=known)
    assert done.returncode == 0, done.stdout + done.stderr


def test_it_finds_nothing_in_any_variant_of_a_sound_asset(run, built):
    done = run(built.asset.root_layer, schemas=str(plugin_path()), program=("-c", _ENGINE))
    assert done.returncode == 0, done.stderr


def test_what_several_rules_look_at_is_gathered_once(built, monkeypatch):
    from usd_validation_nvidia import ValidationEngine

    from usdbrdf.validation.nvidia import Plugin

    looked = []
    monkeypatch.setattr("usdbrdf.validation.rule._asset_paths", lambda x: looked.append(x) or [])
    plugin = Plugin()
    plugin.on_startup()
    try:
        engine = ValidationEngine(init_rules=False, variants=False)
        for checker in plugin._checkers:
            engine.enable_rule(checker)
        engine.validate(str(built.asset.root_layer))
    finally:
        plugin.on_shutdown()
    assert looked
    assert len(set(looked)) == len(looked)


def test_its_engine_finds_a_fault(run, built):
    FAULTS["BindingBesideLooks"](built)
    done = run(built.asset.root_layer, "as selected", program=("-c", _ENGINE))
    assert done.returncode == 1
    assert "UsdBrdfBindingBesideLooks" in done.stderr


def test_it_finds_each_fault_once_with_its_severity(run, built, tmp_path):
    for name in ("BindingBesideLooks", "CameraExposure", "LayerHeader"):
        FAULTS[name](built)
    table = tmp_path / "found.csv"
    only_ours = ("--no-init-rules", "--category", "usdbrdf")
    done = run(*only_ours, "--csv-output", table, built.asset.root_layer)
    assert done.returncode == 1, done.stdout + done.stderr
    found = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    assert sorted((row["Rule"], row["Severity"]) for row in found) == [
        ("UsdBrdfBindingBesideLooks", "Warning"),
        ("UsdBrdfCameraExposure", "Failure"),
        ("UsdBrdfLayerHeader", "Failure"),
    ]
