"""The codeless schemas: generated from their source, found, documented, and missed politely."""

import importlib.util
import json
import math
import os
import re
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import pytest
from pxr import Plug, Sdf, Usd

from tests.synthetic_asset import sky_of
from usdbrdf.asset import schemas
from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layers.author import author_record, over
from usdbrdf.asset.properties import (
    FIT,
    RECORDS,
    SCHEMA_VERSION,
    Fact,
    FittedObject,
    facts_by_attribute,
)
from usdbrdf.asset.readers.compose import open_edited
from usdbrdf.asset.readers.scene import read_fit, read_record
from usdbrdf.asset.review import _judgement
from usdbrdf.asset.schemas import plugin_path, register, verify
from usdbrdf.errors import UsdBrdfError
from usdbrdf.validation.record_rules import allowed_tokens, fit_range, undeclared_attribute
from usdbrdf.validation.rule import AssetStage

VARIABILITY = {True: Sdf.VariabilityUniform, False: Sdf.VariabilityVarying}
SCHEMAS = Path(__file__).resolve().parents[2] / "schemas"
UNITS = (
    "metres|seconds|radians|pixels|texels|counted from 0|without unit|pure numbers|W m-2 sr-1|"
    "units of the pixel values|[Nn]umber of|Loss of the fit"
)
NAMES = ("Object", "Capture", "Aov", "Texturing", "Shading", "MaterialFit", "Emitter", "Outside")


def run_python(code, *arguments, **environment):
    """Standard output of a fresh interpreter, where no schema registry has been built yet."""
    root = str(SCHEMAS.parent)
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, "PYTHONPATH": root, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.strip()


@pytest.fixture
def generate():
    """schemas/generate.py, which is no module of the package."""
    spec = importlib.util.spec_from_file_location("generate", SCHEMAS / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_schema_is_that_of_the_table(generate):
    committed = (SCHEMAS / "schema.usda").read_text()
    assert generate.schema_text() == committed, "run python schemas/generate.py"


def test_generated_files_are_those_of_the_source(generate, tmp_path):
    pytest.importorskip("jinja2", reason="usdGenSchema needs jinja2")
    if Usd.GetVersion() < (0, 26, 8):
        pytest.skip("usd-core brings what usdGenSchema needs from version 26.8 on")
    generate.generate(tmp_path)
    for name in ("schema.usda", "generatedSchema.usda", "plugInfo.json"):
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


def test_usd_knows_what_the_table_declares():
    register()
    verify()
    registry = Usd.SchemaRegistry()
    for name, fact in facts_by_attribute().items():
        definition = registry.FindAppliedAPIPrimDefinition(fact.schema.identifier)
        spec = definition.GetSchemaAttributeSpec(name)
        found = (str(spec.typeName), spec.variability)
        assert found == (fact.type, VARIABILITY[fact.is_uniform]), name


@pytest.mark.parametrize("name", NAMES)
def test_every_attribute_is_known_and_documented(name):
    register()
    verify()
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(f"UsdBrdf{name}API")
    properties = definition.GetPropertyNames()
    assert properties
    source = Sdf.Layer.FindOrOpen(str(SCHEMAS / "schema.usda"))
    for attribute in properties:
        documentation = definition.GetPropertyDocumentation(attribute)
        assert len(documentation) > 30, attribute
        spec = source.GetAttributeAtPath(
            f"/UsdBrdf{name}API.{attribute.removeprefix('usdBrdf:aov:__INSTANCE_NAME__:')}"
        )
        kind = str(spec.typeName)
        if kind.startswith(("float", "double", "int", "color")):
            assert re.search(UNITS, spec.documentation), f"{attribute} has no unit"
        assert (spec.default is not None) or kind == "asset", f"{attribute} has no fallback"
        if spec.HasInfo("allowedTokens"):
            # An empty one says nothing.
            assert spec.default in ("", *spec.GetInfo("allowedTokens"))
            for token in spec.GetInfo("allowedTokens"):
                assert token in spec.documentation, f"{attribute}: {token} is not explained"


def test_what_is_declared_is_authored_and_the_reverse(built):
    """Names, types and variability. The lamp of the small asset is an estimated one; one of its
    objects is made a metal, as a person asked, another a lamp, another a pane, and its photographs
    were taken through a lens, in log, by day."""
    verify()
    frames = built.scan.frames
    paths = frames.image_paths
    frames = replace(
        frames, photographs=paths, masks=paths, lenses=("fisheye",) * len(frames),
        photograph_encoding="acescct_ap1",
    )  # fmt: skip
    built.scan = replace(built.scan, frames=frames)
    built.write_layer("scan")
    first, *others = built.fitted
    metal = replace(first, model="conductor", f0=(0.5, 0.25, 0.125), f0_error=0.03125)
    metal = replace(metal, directive="metal")
    built.fitted = (metal, *others)
    built.write_layer("material")
    lamp, *dark = built.shaded
    built.shaded = (replace(lamp, directive="lamp"), replace(dark[0], lets_through=True), *dark[1:])
    built.outside = sky_of(built.asset)
    built.write_layer("shading")
    built.scan = replace(built.scan, frames=replace(frames, lightings=("day",) * len(frames)))
    built.write_layer("scan")
    authored = {}
    declared = {
        name: (fact.type, VARIABILITY[fact.is_uniform])
        for name, fact in facts_by_attribute().items()
    }

    def visit(path):
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.AttributeSpec) and spec.name.startswith("usdBrdf:"):
            instance = re.sub(r"^usdBrdf:aov:\w+:", "usdBrdf:aov:__INSTANCE_NAME__:", spec.name)
            authored[instance] = (str(spec.typeName), spec.variability)

    for file in (built.asset.folder / "layers").iterdir():
        layer = Sdf.Layer.FindOrOpen(str(file))
        layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    assert authored == declared


def test_the_version_is_in_the_plug_in_and_in_every_layer(built):
    register()
    source = Sdf.Layer.FindOrOpen(str(SCHEMAS / "schema.usda"))
    version = source.customLayerData["usdBrdf"]["schemaVersion"]
    assert version == SCHEMA_VERSION
    plugin = Plug.Registry().GetPluginWithName("usdBrdf")
    assert plugin.metadata["UsdBrdf"]["schemaVersion"] == version
    layers = [*(built.asset.folder / "layers").iterdir(), *built.asset.folder.glob("*.usda")]
    assert len(layers) >= 7
    for layer in layers:
        assert read_provenance(layer)["schemaVersion"] == version, layer


def test_schemas_of_another_version_are_refused_before_the_first_write(monkeypatch):
    register()
    monkeypatch.setattr(schemas, "SCHEMA_VERSION", 99)
    with pytest.raises(UsdBrdfError, match=r"version 2.*99.*\[schema\.version\]"):
        verify()


READ = """
import json, sys
from pxr import Usd
stage = Usd.Stage.Open(sys.argv[1])
assert not stage.GetCompositionErrors()
prim = stage.GetPrimAtPath("/room/geo/Stuhl_No_1/Stuhl_No_1")
phi = prim.GetAttribute("usdBrdf:fit:phi")
print(json.dumps({
    "phi": phi.Get(),
    "known": prim.HasAPI("UsdBrdfMaterialFitAPI"),
    "documented": "Roughness parameter" in phi.GetDocumentation(),
    "applied": "UsdBrdfMaterialFitAPI" in prim.GetMetadata("apiSchemas").GetAddedOrExplicitItems(),
    "imported": "usdbrdf" in sys.modules,
}))
"""


@pytest.mark.parametrize("known", [False, True])
def test_an_application_reads_the_asset_with_and_without_the_schemas(built, known):
    path = str(plugin_path()) if known else ""
    found = json.loads(run_python(READ, str(built.asset.root_layer), PXR_PLUGINPATH_NAME=path))
    assert found == {
        "phi": 0.25, "known": known, "documented": known, "applied": True, "imported": False,
    }  # fmt: skip


KNOWN = """
import os
definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition("UsdBrdfMaterialFitAPI")
assert "usdBrdf:fit:phi" in definition.GetPropertyNames()
assert os.environ["PXR_PLUGINPATH_NAME"] == "", "children get another environment"
from pxr import Plug
known = bool(Plug.Registry().GetPluginWithName("usdbrdf.validation.usd_plugin"))
assert known == (Usd.GetVersion() >= (0, 26, 8))
print("known")
"""


@pytest.mark.parametrize(
    "first",
    [
        "import usdbrdf; from pxr import Usd",
        "from pxr import Usd; import usdbrdf",
        "from pxr import Sdf, Plug; import usdbrdf; from pxr import Usd",
        "import usdbrdf; from pxr import UsdGeom, Usd",
        "import usdbrdf.asset.layout; from pxr import Usd",
        "import usdbrdf; usdbrdf.IngestOptions(); import pxr.Usd as Usd",
    ],
)
def test_importing_the_package_makes_the_schemas_known(first):
    assert run_python(first + KNOWN, PXR_PLUGINPATH_NAME="") == "known"


def test_the_package_is_imported_without_usd_and_leaves_its_modules_as_they_are():
    code = (
        "import sys, usdbrdf; assert not {'pxr', 'numpy', 'cyclopts'} & {*sys.modules}\n"
        "before = list(sys.meta_path); import pxr.Usd, inspect\n"
        "assert not any(type(f).__module__ == 'usdbrdf' for f in sys.meta_path)\n"
        "assert inspect.getsource(pxr.Usd); print('clean')"
    )
    assert run_python(code) == "clean"


def test_a_late_import_is_explained_at_the_first_write():
    code = (
        "from pxr import Usd; Usd.SchemaRegistry()\n"
        "import usdbrdf.asset.schemas as s\n"
        "try: s.verify()\n"
        "except s.UsdBrdfError as error: print(error)"
    )
    message = run_python(code, PXR_PLUGINPATH_NAME="")
    assert "before any stage is opened" in message
    assert str(plugin_path()) in message


def test_a_late_import_is_fine_with_the_environment_variable():
    code = (
        "from pxr import Usd; Usd.SchemaRegistry()\n"
        "import usdbrdf.asset.schemas as s; s.verify(); print('known')"
    )
    assert run_python(code, PXR_PLUGINPATH_NAME=str(plugin_path())) == "known"


@dataclass(frozen=True, kw_only=True)
class GlossyFit(FittedObject):
    """A copy of the table's last record with a row more."""

    gloss: Annotated[
        float, Fact(FIT, "gloss", "float", 0.25, "Gloss, without unit.", low=0, high=1)
    ] = math.nan
    finish: Annotated[
        str, Fact(FIT, "finish", "token", "matt", "matt or satin.", tokens=("matt", "satin"))
    ] = "matt"


def test_a_row_more_is_declared_written_read_back_and_checked(built, generate, monkeypatch):
    records = [*RECORDS[:-1], GlossyFit]
    declaration = "    uniform float usdBrdf:fit:gloss = 0.25 ("
    assert declaration in generate.schema_text(records).splitlines()
    assert declaration not in generate.schema_text().splitlines()

    known, unknown, wrong = (
        GlossyFit(**{**vars(built.fitted[0]), "gloss": gloss, "finish": finish})
        for gloss, finish in ((0.5, "satin"), (math.nan, "matt"), (1.5, "oily"))
    )
    stage = open_edited(built.asset)
    for path, record in zip(built.prims, (known, unknown, wrong), strict=True):
        author_record(over(stage.GetEditTarget().GetLayer(), path), record)
    chair, wall, _ = (stage.GetPrimAtPath(path) for path in built.prims)
    others = {"prim_path": "", "identifier": ""}
    found = read_record(GlossyFit, chair, **others)
    assert (found.gloss, found.finish) == (0.5, "satin")
    assert chair.GetAttribute("usdBrdf:fit:gloss").GetTypeName() == Sdf.ValueTypeNames.Float
    assert not wall.GetAttribute("usdBrdf:fit:gloss")
    assert math.isnan(read_record(GlossyFit, wall, **others).gloss)

    scene = AssetStage(stage)
    assert len(list(undeclared_attribute.check(scene))) == 5
    monkeypatch.setattr("usdbrdf.validation.record_rules.FACTS", facts_by_attribute(records))
    sites = [
        str(fault.site.GetPath())
        for rule in (fit_range, allowed_tokens, undeclared_attribute)
        for fault in rule.check(scene)
    ]
    assert sites == [f"{built.prims[2]}.usdBrdf:fit:{name}" for name in ("gloss", "finish")]


def test_what_an_older_version_called_otherwise_is_read_and_valid(built):
    """fit:kind is fit:model now, and a status of prior undetermined."""
    layer = Sdf.Layer.FindOrOpen(str(built.asset.layer("material")))
    spec = layer.GetPrimAtPath(built.prims[0])
    del spec.properties["usdBrdf:fit:model"]
    for name, word in (("kind", "conductor"), ("status", "prior")):
        attribute = f"usdBrdf:fit:{name}"
        if attribute in spec.properties:
            del spec.properties[attribute]
        token = Sdf.ValueTypeNames.Token, Sdf.VariabilityUniform
        Sdf.AttributeSpec(spec, attribute, *token).default = word
    layer.Save()
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    found = read_fit(stage, built.prims[0])
    assert (found.model, found.is_metal, found.status) == ("conductor", True, "undetermined")
    scene = AssetStage(stage)
    assert not [*allowed_tokens.check(scene), *undeclared_attribute.check(scene)]
    older = {"verdict": "accept", "status": "prior", "phi": found.phi, "psi": found.psi}
    for now in ("undetermined", "bounded"):
        assert _judgement(older, "<chair>").change(replace(found, status=now)) == ""
    assert _judgement(older, "<chair>").change(replace(found, status="measured"))
