"""What is printed with --json, and captures of our own format, are as their schemas say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.json_schemas import INPUTS, SCHEMAS, check, schema_of
from tests.scenes import make_capture
from usdbrdf.asset.properties import FittedObject, facts_of
from usdbrdf.cli import main
from usdbrdf.commands import COMMANDS
from usdbrdf.model.mesh import DIRECTIVES
from usdbrdf.option import option_fields

ROOT = Path(__file__).resolve().parents[1]
NAMES = sorted(file.name.removesuffix(".schema.json") for file in SCHEMAS.glob("*.json"))
OF_STEPS = {"convert", "ingest", "texture", "shade", "fit"}
SILENT = {"view"}  # it serves until it is stopped
jsonschema = pytest.importorskip("jsonschema", reason="needs the extra test")


@pytest.mark.parametrize("name", NAMES)
def test_they_are_schemas(name):
    jsonschema.Draft202012Validator.check_schema(schema_of(name))
    assert schema_of(name)["$id"] == f"usdbrdf/{name}.schema.json"


def test_every_command_that_prints_json_has_one():
    printing = {
        name
        for name, command in COMMANDS.items()
        if any(item.name == "json" for item in option_fields(command))
    }
    assert printing >= OF_STEPS
    assert (printing - OF_STEPS - SILENT) | {"run"} | INPUTS == set(NAMES)


def test_objects():
    sample = json.loads((ROOT / "samples/study/objects.json").read_text("utf-8"))
    check(sample, "objects")
    sample["objects"][0]["directive"] = "gold"
    with pytest.raises(jsonschema.ValidationError, match="gold"):
        check(sample, "objects")
    enum = schema_of("objects")["properties"]["objects"]["items"]["properties"]["directive"]["enum"]
    assert sorted(enum) == sorted(["", *DIRECTIVES])


def test_doctor(capsys):
    main(["doctor", "--json"])
    document = json.loads(capsys.readouterr().out)
    check(document, "doctor")
    document["findings"][0]["state"] = "perhaps"
    with pytest.raises(jsonschema.ValidationError, match="perhaps"):
        check(document, "doctor")


def test_runs_and_captures(tmp_path, capsys):
    sample = json.loads((ROOT / "samples/study/transforms.json").read_text("utf-8"))
    check(sample, "transforms")
    made = make_capture(tmp_path / "scan")
    copy = tmp_path / "copy"
    place = [str(made.folder), "-o", str(tmp_path / "out"), "--write-capture", str(copy)]
    assert main(["ingest", "--json", *place]) == 0
    check(json.loads(capsys.readouterr().out), "run")
    document = json.loads((copy / "transforms.json").read_text("utf-8"))
    check(document, "transforms")
    document["frames"][0]["exposure_time"] = 0
    with pytest.raises(jsonschema.ValidationError):
        check(document, "transforms")


def test_what_a_schema_does_not_name_is_found():
    done = {"reran": False, "reason": "done", "texels": 7}
    check({"asset": "a.usda", "steps": {"texture": done}}, "run")
    with pytest.raises(jsonschema.ValidationError, match="texel_count"):
        check({"asset": "a.usda", "steps": {"texture": {**done, "texel_count": 7}}}, "run")


def test_words_of_a_fit_are_those_of_the_asset():
    facts, told = dict(facts_of(FittedObject)), schema_of("run")["$defs"]["fitted"]["properties"]
    enums = {name: item["enum"] for name, item in told.items() if "enum" in item}
    assert {*enums} >= {"status", "model", "phi_confidence", "psi_confidence", "directive"}
    assert enums == {name: [*facts[name].tokens] for name in enums}


def test_what_a_fit_says_is_checked():
    none = {"phi": None, "psi": 0.1, "phi_error": None, "psi_error": 0.2, "psi_upper": 0.9}
    fit = {"reran": True, "reason": "not done before"}
    found = {**none, "status": "undetermined", "model": "dielectric"}
    check({"asset": "a.usda", "steps": {"fit": {**fit, "objects": {"chair": found}}}}, "run")
    found["phi"] = "0.2"
    with pytest.raises(jsonschema.ValidationError):
        check({"asset": "a.usda", "steps": {"fit": {**fit, "objects": {"chair": found}}}}, "run")
