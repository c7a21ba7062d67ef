"""What is printed with --json against its schema."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

SCHEMAS = Path(__file__).resolve().parents[1] / "schemas/json"


def schema_of(name: str) -> dict[str, object]:
    return json.loads((SCHEMAS / f"{name}.schema.json").read_text("utf-8"))


def check(document: object, name: str) -> None:
    """Fails where the document is not as the schema of this name says."""
    jsonschema = pytest.importorskip("jsonschema", reason="needs the extra test")
    jsonschema.Draft202012Validator(schema_of(name)).validate(document)


def checked(text: str, name: str) -> object:
    """The document in a text, which is as its schema says."""
    document = json.loads(text)
    check(document, name)
    return document
