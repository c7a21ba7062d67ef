"""Write schema.usda, generatedSchema.usda and plugInfo.json from ``usdbrdf.asset.properties``.

    python schemas/generate.py [FOLDER]        FOLDER: where to write, by default beside this file

Runs usdGenSchema of the usd-core package, which needs jinja2, and turns its template of a
plugInfo.json into one for a folder that holds nothing but these resources.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pxr import Sdf

from usdbrdf.asset.properties import (
    INSTANCE,
    RECORDS,
    SCHEMA_VERSION,
    SCHEMAS,
    Fact,
    Schema,
    facts_by_attribute,
    facts_of,
)

HERE = Path(__file__).resolve().parent

HEADER = '''#usda 1.0
(
    """usdBrdf: applied API schemas for captured scenes with measured materials.

    The schemas are codeless: the stage opens and renders everywhere without them. With them,
    every attribute has a type, a unit and a documented meaning in any USD application.
    Written by schemas/generate.py from usdbrdf/asset/properties.py: do not edit."""
    subLayers = [
        @usd/schema.usda@
    ]
    customLayerData = {
        dictionary usdBrdf = {
            int schemaVersion = %d
        }
    }
)

over "GLOBAL" (
    customData = {
        string libraryName = "usdBrdf"
        string libraryPath = "."
        string libraryPrefix = "UsdBrdf"
        bool skipCodeGeneration = true
    }
)
{
}
'''


def generate(out: Path) -> None:
    """Write the three files to ``out``."""
    source = out / "schema.usda"
    source.write_text(schema_text(), encoding="utf-8")
    with tempfile.TemporaryDirectory() as temporary:
        command = [sys.executable, "-m", "pxr.Usd.usdGenSchema", str(source), temporary]
        subprocess.run(command, check=True, capture_output=True, text=True)
        generated = Sdf.Layer.OpenAsAnonymous(str(Path(temporary) / "generatedSchema.usda"))
        plug_info = (Path(temporary) / "plugInfo.json").read_text(encoding="utf-8")
    _document(generated)
    lines = [line.rstrip() for line in generated.ExportToString().splitlines()]
    text = "\n".join(lines).rstrip("\n") + "\n"
    (out / "generatedSchema.usda").write_text(text, encoding="utf-8")
    (out / "plugInfo.json").write_text(resource_plug_info(plug_info), encoding="utf-8")


def schema_text(records: Sequence[type] = RECORDS) -> str:
    """schema.usda of the table's rows."""
    facts = [fact for record in records for _, fact in facts_of(record)]
    classes = [
        _class(schema, [fact for fact in facts if fact.schema == schema]) for schema in SCHEMAS
    ]
    return "\n".join([HEADER % SCHEMA_VERSION, *classes])


def _class(schema: Schema, facts: Sequence[Fact]) -> str:
    kind = "multipleApply" if schema.is_multiple else "singleApply"
    prefix = schema.namespace.removesuffix(f":{INSTANCE}")
    multiple = [f'        token propertyNamespacePrefix = "{prefix}"'] if schema.is_multiple else []
    lines = [
        f'class "{schema.identifier}" (',
        "    inherits = </APISchemaBase>",
        f'    doc = """{_line(schema.doc)}"""',
        "    customData = {",
        f'        string className = "{schema.name}API"',
        f'        token apiSchemaType = "{kind}"',
        *multiple,
        f'        token[] apiSchemaCanOnlyApplyTo = ["{schema.prims}"]',
        "    }",
        ")",
        "{",
        *(line for fact in facts for line in _attribute(fact)),
        "}",
    ]
    return "\n".join(lines) + "\n"


def _attribute(fact: Fact) -> list[str]:
    name = fact.name if fact.schema.is_multiple else fact.attribute()
    uniform = "uniform " if fact.is_uniform else ""
    tokens = [f"        allowedTokens = {json.dumps(fact.tokens)}"] if fact.tokens else []
    return [
        f"    {uniform}{fact.type} {name} = {_literal(fact)} (",
        f'        doc = """{_line(fact.doc)}"""',
        *tokens,
        "    )",
    ]


def _line(doc: str) -> str:
    return " ".join(doc.split())


def _literal(fact: Fact) -> str:
    value: Any = fact.fallback
    if fact.type == "asset":
        return "@@"
    if isinstance(value, str):
        return json.dumps(value)
    return str(value) if isinstance(value, tuple) else f"{value:g}"


def resource_plug_info(generated: str) -> str:
    """plugInfo.json as plain JSON, with the paths of a plug-in that has no library.

    The generator writes ``#`` comments, and placeholders that a build system would fill in; with
    them left in place USD registers the types but gives them no attributes.
    """
    lines = [line for line in generated.splitlines() if not line.lstrip().startswith("#")]
    info = json.loads("\n".join(lines))
    for plugin in info["Plugins"]:
        plugin.update(LibraryPath="", ResourcePath=".", Root=".")
        plugin["Info"]["UsdBrdf"] = {"schemaVersion": SCHEMA_VERSION}
    return json.dumps(info, indent=4, sort_keys=True) + "\n"


def _document(generated: Sdf.Layer) -> None:
    """Restore the documentation, of which the generator keeps the first sentences in customData,
    where applications do not look for it."""
    for schema in SCHEMAS:
        generated.GetPrimAtPath(f"/{schema.identifier}").documentation = _line(schema.doc)
    for name, fact in facts_by_attribute().items():
        path = f"/{fact.schema.identifier}.{name}"
        generated.GetAttributeAtPath(path).documentation = _line(fact.doc)


if __name__ == "__main__":
    generate(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
