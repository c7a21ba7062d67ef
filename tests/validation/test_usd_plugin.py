"""UsdValidation knows our rules and cures, as validators and fixers."""

import json
import os
import subprocess
import sys

import pytest
from pxr import Sdf, Usd, UsdValidation

from tests.validation.faults import FAULTS
from usdbrdf.asset.schemas import validators_path
from usdbrdf.cli import main
from usdbrdf.validation.usd_plugin import PLUGIN, plug_info
from usdbrdf.validation.validate import RULES

pytestmark = pytest.mark.skipif(
    not hasattr(UsdValidation.ValidationRegistry, "RegisterPluginStageValidator"),
    reason="this usd-core takes validators from C++ alone",
)
NOW = Usd.TimeCode.Default


def errors_of(stage):
    registry = UsdValidation.ValidationRegistry()
    suite = registry.GetOrLoadValidatorSuiteByName(f"{PLUGIN}:All")
    assert len(suite.GetContainedValidators()) == len(RULES)
    return UsdValidation.ValidationContext(suites=[suite]).Validate(stage)


def test_plug_info_is_that_of_the_rules():
    written = (validators_path() / "plugInfo.json").read_text(encoding="utf-8")
    assert written == plug_info(), "run python -m usdbrdf.validation.usd_plugin"


def test_a_sound_asset_has_no_errors(built):
    assert errors_of(Usd.Stage.Open(str(built.asset.root_layer))) == []


@pytest.mark.parametrize("name", ["LayerHeader", "CameraExposure", "BindingBesideLooks"])
def test_faults_are_errors_of_the_validator_of_that_name(built, name):
    FAULTS[name](built)
    errors = errors_of(Usd.Stage.Open(str(built.asset.root_layer)))
    assert {error.GetIdentifier() for error in errors} == {f"{PLUGIN}:{name}.{name}"}
    warns = {rule.name: rule.severity.value == "warning" for rule in RULES}[name]
    kinds = UsdValidation.ValidationErrorType
    assert {error.GetType() for error in errors} == {kinds.Warn if warns else kinds.Error}


@pytest.mark.skipif(
    Usd.GetVersion() < (0, 26, 11), reason="this usd-core takes fixers from C++ alone"
)
def test_a_fixer_writes_into_the_layer_that_the_user_names(built):
    FAULTS["CameraExposure"](built)
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    (error,) = errors_of(stage)
    (fixer,) = error.GetFixers()
    layers = {x.identifier: x for x in stage.GetUsedLayers() if x != stage.GetSessionLayer()}
    before = {name: layer.ExportToString() for name, layer in layers.items()}
    ours = [built.asset.root_layer, *(built.asset.layer(role) for role in ("scan", "material"))]
    for layer in ours:
        target = Usd.EditTarget(layers[str(layer)])
        assert not fixer.CanApplyFix(error, target, NOW())
        assert not fixer.ApplyFix(error, target, NOW())
    cures = Sdf.Layer.CreateNew(str(built.asset.folder / "cures.usda"))
    stage.GetSessionLayer().subLayerPaths.insert(0, cures.identifier)
    assert fixer.CanApplyFix(error, Usd.EditTarget(cures), NOW())
    assert fixer.ApplyFix(error, Usd.EditTarget(cures), NOW())
    assert errors_of(stage) == []
    assert before == {name: layer.ExportToString() for name, layer in layers.items()}


def test_other_applications_find_them_and_the_schemas_by_the_environment_variable(built, capsys):
    FAULTS["FitRange"](built)
    code = (
        "import sys\n"
        "from pxr import Usd, UsdValidation as V\n"
        "registry = V.ValidationRegistry()\n"
        "names = [m.name for m in registry.GetValidatorMetadataForKeyword('usdBrdf')]\n"
        "schema = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition('UsdBrdfMaterialFitAPI')\n"
        "assert 'usdBrdf:fit:phi' in schema.GetPropertyNames()\n"
        "assert 'usdbrdf' not in sys.modules\n"
        "found = V.ValidationContext(keywords=['usdBrdf']).Validate(Usd.Stage.Open(sys.argv[1]))\n"
        "import json; print(json.dumps([len(names), [e.GetName() for e in found]]))"
    )
    root = str(validators_path().parents[1])
    assert main(["plugin-path"]) == 0
    paths = capsys.readouterr().out.strip()
    done = subprocess.run(
        [sys.executable, "-c", code, str(built.asset.root_layer)],
        env={**os.environ, "PYTHONPATH": root, "PXR_PLUGINPATH_NAME": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    number, names = json.loads(done.stdout)
    assert number == len(RULES) + 1
    assert set(names) == {"FitRange"}
