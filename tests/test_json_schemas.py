"""What is printed with --json, and captures of our own format, are as their schemas say."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.scenes import make_capture
from usdbrdf.cli import main

ROOT = Path(__file__).resolve().parents[1]
SCHEMAS = sorted((ROOT / "schemas/json").glob("*.schema.json"))
jsonschema = pytest.importorskip("jsonschema", reason="needs the extra test")


def check(document: object, name: str) -> None:
    schema = json.loads((ROOT / f"schemas/json/{name}.schema.json").read_text("utf-8"))
    jsonschema.Draft202012Validator(schema).validate(document)


@pytest.mark.parametrize("file", SCHEMAS, ids=lambda file: file.name)
def test_they_are_schemas(file):
    jsonschema.Draft202012Validator.check_schema(json.loads(file.read_text("utf-8")))


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


def test_what_a_fit_says_is_checked():
    none = {"phi": None, "psi": 0.1, "phi_error": None, "psi_error": 0.2, "psi_upper": 0.9}
    fit = {"reran": True, "reason": "not done before"}
    found = {**none, "status": "prior", "kind": "dielectric"}
    check({"asset": "a.usda", "steps": {"fit": {**fit, "objects": {"chair": found}}}}, "run")
    found["phi"] = "0.2"
    with pytest.raises(jsonschema.ValidationError):
        check({"asset": "a.usda", "steps": {"fit": {**fit, "objects": {"chair": found}}}}, "run")
