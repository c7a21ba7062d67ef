"""The codeless schemas: generated from their source, found, documented, and missed politely."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from pxr import Usd

from usdbrdf.stage.schema import plugin_path, register, verify

SCHEMAS = Path(__file__).resolve().parents[2] / "schemas"
NAMES = ("Object", "Capture", "Aov", "Texturing", "Shading", "MaterialFit", "Emitter")


def run_python(code, **environment):
    """Standard output of a fresh interpreter, where no schema registry has been built yet."""
    root = str(SCHEMAS.parent)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": root, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


def test_generated_files_are_those_of_the_source(tmp_path):
    pytest.importorskip("jinja2", reason="usdGenSchema needs jinja2")
    if Usd.GetVersion() < (0, 26, 8):
        pytest.skip("usd-core brings what usdGenSchema needs from version 26.8 on")
    spec = importlib.util.spec_from_file_location("generate", SCHEMAS / "generate.py")
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    generate.generate(tmp_path)
    for name in ("generatedSchema.usda", "plugInfo.json"):
        assert (tmp_path / name).read_text() == (SCHEMAS / name).read_text(), (
            f"{name} is stale: run schemas/generate.py"
        )


def test_plug_info_is_plain_json_without_placeholders():
    text = (SCHEMAS / "plugInfo.json").read_text()
    (plugin,) = json.loads(text)["Plugins"]
    assert plugin["Type"] == "resource"
    assert set(plugin["Info"]["Types"]) == {f"UsdBrdf{name}API" for name in NAMES}
    assert "@" not in text


def test_plugin_path_holds_the_plug_info():
    assert (plugin_path() / "plugInfo.json").is_file()


@pytest.mark.parametrize("name", NAMES)
def test_every_attribute_is_known_and_documented(name):
    register()
    verify()
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(f"UsdBrdf{name}API")
    properties = definition.GetPropertyNames()
    assert properties
    for attribute in properties:
        assert len(definition.GetPropertyDocumentation(attribute)) > 30, attribute


def test_importing_the_package_makes_the_schemas_known():
    code = "import usdbrdf.stage.schema as s; s.verify(); print('known')"
    assert run_python(code, PXR_PLUGINPATH_NAME="") == "known"


def test_a_late_import_is_explained_at_the_first_write():
    code = (
        "from pxr import Usd; Usd.SchemaRegistry()\n"
        "import usdbrdf.stage.schema as s\n"
        "try: s.verify()\n"
        "except s.UsdBrdfError as error: print(error)"
    )
    message = run_python(code, PXR_PLUGINPATH_NAME="")
    assert "before any stage is opened" in message
    assert str(plugin_path()) in message


def test_a_late_import_is_fine_with_the_environment_variable():
    code = (
        "from pxr import Usd; Usd.SchemaRegistry()\n"
        "import usdbrdf.stage.schema as s; s.verify(); print('known')"
    )
    assert run_python(code, PXR_PLUGINPATH_NAME=str(plugin_path())) == "known"
