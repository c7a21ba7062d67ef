"""Every rule finds its fault and nothing else does; a sound asset has none."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd

from tests.validation.faults import (
    CHAIR,
    COLOUR_TEXTURE,
    FAULTS,
    SURFACE,
    Types,
    edited,
    opinion,
    said_in_a_review,
    seen_of_chair,
)
from usdbrdf.files.images import write_exr
from usdbrdf.validation.rule import AssetStage, Severity
from usdbrdf.validation.validate import RULES, own_findings, validate

BY_NAME = {rule.name: rule for rule in RULES}


def own(built):
    return own_findings(Usd.Stage.Open(str(built.asset.root_layer)))


def test_every_rule_has_a_fault_and_a_description():
    assert list(BY_NAME) == list(FAULTS)
    assert len(RULES) == len(BY_NAME)
    for rule in RULES:
        assert len(rule.description) > 80, rule.name
        assert len(rule.advice) > 20, rule.name


def test_a_sound_asset_has_no_findings(built):
    assert own(built) == []


@pytest.mark.parametrize("name", FAULTS)
def test_exactly_the_rule_about_a_fault_finds_it(built, name):
    FAULTS[name](built)
    findings = own(built)
    assert {finding.rule for finding in findings} == {f"usdbrdf.{name}"}
    for finding in findings:
        assert finding.severity is BY_NAME[name].severity
        line = str(finding)
        assert line.startswith(f"{finding.severity.value}: ")
        assert line.endswith(f" [usdbrdf.{name}]")
        assert "\n" not in line
        assert re.match(r"\w+: </[^>]*> @/.+\.usd[ac]?@: ", line)


def test_a_finding_names_the_layer_that_has_the_opinion(built):
    FAULTS["AllowedTokens"](built)
    FAULTS["CameraExposure"](built)
    FAULTS["LayerHeader"](built)
    asset = built.asset
    assert {(f.site, f.layer) for f in own(built)} == {
        (f"<{CHAIR}.usdBrdf:fit:status>", f"@{asset.edits_layer}@"),
        ("</room/cameras/capture>", f"@{asset.root_layer}@"),
        ("</room>", f"@{asset.layer('texturing')}@"),
    }


@pytest.mark.parametrize("name", sorted(n for n in FAULTS if BY_NAME[n].cure))
def test_a_cure_cures_in_the_layer_that_is_asked_for(built, name):
    FAULTS[name](built)
    folder = built.asset.folder
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    cures = Sdf.Layer.CreateNew(str(folder / "cures.usda"))
    stage.GetSessionLayer().subLayerPaths.insert(0, cures.identifier)
    stage.SetEditTarget(Usd.EditTarget(cures))
    scene = AssetStage(stage)  # what it finds in other looks holds as long as it does
    faults = list(BY_NAME[name].check(scene))
    assert faults
    assert all(BY_NAME[name].cure.apply(fault.site) for fault in faults)
    assert own_findings(stage) == []
    assert before == {p: p.read_bytes() for p in before}


def test_what_an_artist_may_say_is_no_fault(built):
    opinion(built, SURFACE, "inputs:roughness", Types.Float, 0.9)
    opinion(built, SURFACE, "inputs:ior", Types.Float, 1.2)
    opinion(built, f"{SURFACE}", "inputs:useSpecularWorkflow", Types.Int, 1)
    opinion(built, SURFACE, "inputs:specularColor", Types.Color3f, (0.1, 0.1, 0.1))
    with edited(built.asset.edits_layer) as layer:
        path = "/room{look=mine}geo/lamp/lamp"
        binding = Sdf.RelationshipSpec(
            Sdf.CreatePrimInLayer(layer, path), "material:binding", custom=False
        )
        binding.targetPathList.explicitItems = [Sdf.Path("/room/geo/wall/mtl/wall")]
        layer.GetPrimAtPath("/room").variantSelections["look"] = "mine"
    assert own(built) == []


@pytest.mark.parametrize("prim", ["/room", "/room/geo"])
@pytest.mark.parametrize("aside", ["active", "instanceable"])
def test_objects_that_an_artist_sets_aside_are_not_lost(built, prim, aside):
    with edited(built.asset.edits_layer) as layer:
        Sdf.CreatePrimInLayer(layer, prim).SetInfo(aside, aside != "active")
    assert own(built) == []


@pytest.mark.parametrize("prim", [Path(CHAIR).parent.as_posix(), CHAIR])
def test_an_object_that_was_judged_may_be_set_aside(built, prim):
    said_in_a_review(built, verdict="reject", comment="too green", **seen_of_chair(built))
    with edited(built.asset.edits_layer) as layer:
        Sdf.CreatePrimInLayer(layer, prim).SetInfo("active", False)
    assert own(built) == []
    said_in_a_review(built, verdict="perhaps")
    (finding,) = own(built)
    assert finding.rule == "usdbrdf.ReviewRecord"


def test_a_part_of_an_asset_has_lost_nothing(built):
    mask = Usd.StagePopulationMask(["/room/cameras"])
    assert own_findings(Usd.Stage.OpenMasked(str(built.asset.root_layer), mask)) == []
    for layer in (built.asset.folder / "layers").iterdir():
        found = own_findings(Usd.Stage.Open(str(layer)))
        assert not [finding for finding in found if finding.rule == "usdbrdf.ObjectMesh"]


@pytest.mark.parametrize("attribute", ["ior", "scale"])
def test_a_lobe_that_was_matched_is_judged_as_such(built, attribute):
    built.fitted = tuple(replace(item, mapping="matched") for item in built.fitted)
    built.write_layer("material")
    assert own(built) == []
    with edited(built.asset.layer("material")) as layer:
        spec = layer.GetAttributeAtPath(f"{SURFACE}.inputs:ior")
        if attribute == "scale":
            spec = layer.GetAttributeAtPath(
                "/room/geo/Stuhl_No_1/mtl/Stuhl_No_1/BaseColorTexture.inputs:scale"
            )
        spec.default = spec.default * 1.01
    (finding,) = own(built)
    assert finding.rule == "usdbrdf.LobeMatchesFit"
    assert "under the mapping matched" in finding.message


def test_a_mapping_that_is_not_known_is_not_judged_by_another(built):
    opinion(built, CHAIR, "usdBrdf:fit:mapping", Types.Token, "of tomorrow")
    opinion(built, CHAIR, "usdBrdf:fit:phi", Types.Float, 0.75)
    assert {f.rule for f in own(built)} == {"usdbrdf.AllowedTokens"}


def test_a_lamp_counts_once_with_its_lights_alone_or_its_glow_alone(built):
    with edited(built.asset.edits_layer) as layer:
        layer.GetPrimAtPath("/room").variantSelections["lights"] = "usdlux"
    assert own(built) == []
    surface = "/room/geo/lamp/mtl/lamp/PreviewSurface"
    with edited(built.asset.edits_layer) as layer:
        prim = Sdf.CreatePrimInLayer(layer, surface)
        glow = Sdf.AttributeSpec(prim, "inputs:emissiveColor", Types.Color3f)
        glow.default = (1, 1, 1)
        glow.connectionPathList.ClearEditsAndMakeExplicit()
    assert [(f.site, f.rule) for f in own(built)] == [
        (f"<{surface}.inputs:emissiveColor>", "usdbrdf.LampTwice")
    ]
    with edited(built.asset.edits_layer) as layer:
        Sdf.CreatePrimInLayer(layer, "/room/lights/lamp").SetInfo("active", False)
    assert own(built) == []


URIS = ("https://example.org/wood.exr", "asset:wood.exr")


@pytest.mark.parametrize("uri", URIS)
def test_what_a_resolver_finds_is_not_looked_for(built, uri):
    opinion(built, COLOUR_TEXTURE, "inputs:file", Types.Asset, Sdf.AssetPath(uri))
    with edited(built.asset.edits_layer) as layer:
        layer.GetPrimAtPath("/room").customData = {"sheet": Sdf.AssetPath(uri)}
    (finding,) = own(built)
    assert (finding.rule, finding.severity) == ("usdbrdf.AnchoredPath", Severity.WARNING)
    assert f"@{uri}@" in finding.message


@pytest.mark.parametrize("metadata", ["assetInfo", "customData", "clips"])
def test_paths_in_metadata_count(built, metadata):
    with edited(built.asset.edits_layer) as layer:
        value = {"one": {"manifestAssetPath": Sdf.AssetPath("./gone.usda")}}
        layer.GetPrimAtPath("/room").SetInfo(metadata, value)
    (finding,) = own(built)
    assert finding.rule == "usdbrdf.MissingTexture"
    assert "gone.usda@ does not exist" in finding.message
    with edited(built.asset.edits_layer) as layer:
        value = {"one": {"manifestAssetPath": Sdf.AssetPath(str(built.asset.edits_layer))}}
        layer.GetPrimAtPath("/room").SetInfo(metadata, value)
    assert {f.rule for f in own(built)} == {"usdbrdf.AnchoredPath"}


def test_paths_in_layers_of_the_folder_that_are_referenced_count(built):
    prop = Sdf.Layer.CreateNew(str(built.asset.folder / "prop.usda"))
    spec = Sdf.CreatePrimInLayer(prop, "/prop")
    Sdf.AttributeSpec(spec, "sheet", Types.Asset).default = Sdf.AssetPath("../sheet.exr")
    prop.Save()
    write_exr(built.asset.folder.parent / "sheet.exr", np.ones((2, 2, 3), np.float32))
    with edited(built.asset.edits_layer) as layer:
        prim = Sdf.CreatePrimInLayer(layer, "/room/prop")
        prim.referenceList.prependedItems = [Sdf.Reference("./prop.usda", "/prop")]
    (finding,) = own(built)
    assert finding.rule == "usdbrdf.PathOutside"
    assert "prop.usda@ leads out" in finding.message


def test_rules_have_nothing_to_say_about_stages_of_others(tmp_path):
    stage = Usd.Stage.CreateNew(str(tmp_path / "other.usda"))
    mesh = stage.DefinePrim("/world/mesh", "Mesh")
    mesh.CreateAttribute("texture", Sdf.ValueTypeNames.Asset).Set("/somewhere/else.exr")
    mesh.CreateRelationship("material:binding").SetTargets(["/world/no"])
    assert own_findings(stage) == []


def test_records_are_checked_wherever_the_asset_is_referenced(built, tmp_path):
    FAULTS["FitRange"](built)
    shot = Usd.Stage.CreateNew(str(tmp_path / "shot.usda"))
    shot.DefinePrim("/shot").GetReferences().AddReference(str(built.asset.root_layer))
    found = own_findings(shot)
    assert [(f.site, f.rule) for f in found] == [
        ("</shot/geo/Stuhl_No_1/Stuhl_No_1.usdBrdf:fit:phi>", "usdbrdf.FitRange")
    ]


def test_findings_of_an_error_and_a_warning(built):
    FAULTS["BindingBesideLooks"](built)
    FAULTS["MissingPhotograph"](built)
    severities = {f.severity for f in validate(built.asset.root_layer) if "usdbrdf." in f.rule}
    assert severities == {Severity.WARNING}
