"""Write generatedSchema.usda and plugInfo.json from schema.usda.

    python schemas/generate.py [FOLDER]        FOLDER: where to write, by default beside schema.usda

Runs usdGenSchema of the usd-core package, which needs jinja2, and turns its template of a
plugInfo.json into one for a folder that holds nothing but these resources, with the version that
schema.usda states.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from pxr import Sdf

HERE = Path(__file__).resolve().parent


def generate(out: Path) -> None:
    """Run the generator in a temporary folder and write its two files, cleaned, to ``out``."""
    with tempfile.TemporaryDirectory() as temporary:
        command = [sys.executable, "-m", "pxr.Usd.usdGenSchema"]
        command += [str(HERE / "schema.usda"), temporary]
        subprocess.run(command, check=True, capture_output=True, text=True)
        generated = Sdf.Layer.OpenAsAnonymous(str(Path(temporary) / "generatedSchema.usda"))
        plug_info = (Path(temporary) / "plugInfo.json").read_text(encoding="utf-8")
    source = Sdf.Layer.OpenAsAnonymous(str(HERE / "schema.usda"))
    _document(generated, source)
    text = _trimmed(generated.ExportToString())
    (out / "generatedSchema.usda").write_text(text, encoding="utf-8")
    version = source.customLayerData["usdBrdf"]["schemaVersion"]
    written = resource_plug_info(plug_info, version)
    (out / "plugInfo.json").write_text(written, encoding="utf-8")


def resource_plug_info(generated: str, version: int) -> str:
    """plugInfo.json as plain JSON, with the paths of a plug-in that has no library.

    The generator writes ``#`` comments, and placeholders that a build system would fill in; with
    them left in place USD registers the types but gives them no attributes.
    """
    lines = [line for line in generated.splitlines() if not line.lstrip().startswith("#")]
    info = json.loads("\n".join(lines))
    for plugin in info["Plugins"]:
        plugin.update(LibraryPath="", ResourcePath=".", Root=".")
        plugin["Info"]["UsdBrdf"] = {"schemaVersion": version}
    return json.dumps(info, indent=4, sort_keys=True) + "\n"


def _document(generated: Sdf.Layer, source: Sdf.Layer) -> None:
    """Restore the documentation, of which the generator keeps the first sentences in customData,
    where applications do not look for it."""
    for schema in source.rootPrims:
        found = generated.GetPrimAtPath(schema.path)
        if found and schema.documentation:
            found.documentation = schema.documentation
            prefix = schema.customData.get("propertyNamespacePrefix")
            for attribute in schema.attributes:
                # Of a schema that applies several times.
                name = f"{prefix}:__INSTANCE_NAME__:{attribute.name}" if prefix else attribute.name
                found.attributes[name].documentation = attribute.documentation


def _trimmed(text: str) -> str:
    return "\n".join(line.rstrip() for line in text.splitlines()).rstrip("\n") + "\n"


if __name__ == "__main__":
    generate(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
