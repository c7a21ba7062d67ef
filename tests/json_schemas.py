"""What is printed with --json against its schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

# Documents that no command prints; others write into them, too.
INPUTS = {"transforms", "objects"}
SCHEMAS = Path(__file__).resolve().parents[1] / "schemas/json"


def schema_of(name: str) -> dict[str, object]:
    return json.loads((SCHEMAS / f"{name}.schema.json").read_text("utf-8"))


def check(document: object, name: str) -> None:
    """Fails where the document is not as the schema of this name says, or holds what that does not
    tell of. Schemas themselves allow more: keys may be added within a major version."""
    jsonschema = pytest.importorskip("jsonschema", reason="needs the extra test")
    schema = schema_of(name)
    told = schema if name in INPUTS else _closed(schema)
    jsonschema.Draft202012Validator(told).validate(document)


def _closed(schema: Any) -> Any:
    """The same without room for keys that it does not name."""
    if isinstance(schema, list):
        return [_closed(each) for each in schema]
    if not isinstance(schema, dict):
        return schema
    closed = {key: _closed(each) for key, each in schema.items()}
    if schema.get("type") == "object" and "properties" in schema:
        closed.setdefault("additionalProperties", False)
    return closed


def checked(text: str, name: str) -> object:
    """The document in a text, which is as its schema says."""
    document = json.loads(text)
    check(document, name)
    return document
