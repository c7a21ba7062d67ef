"""Sound assets have no findings; unsound ones say what is wrong."""

import pytest
from pxr import Sdf, Usd

from tests.json_schemas import checked
from tests.validation.faults import edited, opinion
from usdbrdf.asset.layout import ROLES
from usdbrdf.cli import main
from usdbrdf.files.atomic import sha256_of
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.job.stamp import stamp_of, stamp_path, write_stamp
from usdbrdf.validation.rule import Severity
from usdbrdf.validation.validate import has_errors, listed_rules, own_findings, validate


@pytest.mark.parametrize("upto", ROLES)
@pytest.mark.parametrize("folder", ["room", "Zimmer é 椅子 (1)", 'a @ # ; [1] "x% <UDIM>'])
def test_an_asset_has_no_findings_after_any_stage(tmp_path, synthetic, upto, folder):
    scan = synthetic.make_scan(tmp_path / f"capture {folder}", unit=0.01, up_axis="Y")
    built = synthetic.build(tmp_path / folder, scan, upto=upto)
    assert validate(built.asset.root_layer) == []


def test_a_missing_texture_and_photograph_are_named(built):
    (built.asset.folder / "textures" / "lamp.lit.exr").unlink()
    built.scan.frames.image_paths[2].unlink()
    findings = "\n".join(map(str, validate(built.asset.root_layer)))
    assert "lamp.lit.exr@ does not exist. It is named 2 times. [usdbrdf.MissingTexture]" in findings
    assert "frame 02 é.exr@ does not exist. [usdbrdf.MissingPhotograph]" in findings


def test_an_asset_without_its_whole_capture_is_not_warned_of(built):
    """It is whole without; a capture of which some is missing is likely not what was meant."""
    first, *others = built.scan.frames.image_paths
    first.unlink()
    (finding,) = validate(built.asset.root_layer)
    assert (finding.rule, finding.severity) == ("usdbrdf.MissingPhotograph", Severity.WARNING)
    for photograph in others:
        photograph.unlink()
    (finding,) = validate(built.asset.root_layer)
    assert (finding.rule, finding.severity) == ("usdbrdf.MissingPhotograph", Severity.INFO)


def test_usds_own_validators_are_asked(built):
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    prim = Sdf.CreatePrimInLayer(edits, "/room/geo/wall/wall")
    binding = Sdf.RelationshipSpec(prim, "material:binding:mine", custom=False)
    binding.targetPathList.explicitItems = [
        Sdf.Path("/room/geo/wall/mtl/wall"),
        Sdf.Path("/room/geo/lamp/mtl/lamp"),
    ]
    edits.Save()
    findings = validate(built.asset.root_layer)
    assert any(
        "</room/geo/wall/wall" in f.site and "usdShadeValidators:" in f.rule for f in findings
    )


@pytest.mark.parametrize("role", ROLES)
def test_a_missing_layer_is_one_finding(built, role):
    """Not one for each thing that it held, nor one of each rule that meets it."""
    built.asset.layer(role).unlink()
    (finding,) = validate(built.asset.root_layer)
    assert finding.rule == "usdbrdf.LayerMissing"
    assert f"its sublayer @{built.asset.layer(role)}@ is not there." in finding.message


def test_a_missing_payload_is_one_finding(built):
    built.asset.contents_layer.unlink()
    (finding,) = validate(built.asset.root_layer)
    assert finding.rule == "usdbrdf.LayerMissing"
    assert f"its payload @{built.asset.contents_layer}@ is not there." in finding.message


def test_maps_that_were_mixed_up_are_an_error(built):
    mixed, other = (built.asset.folder / f"textures/{n}.lit.exr" for n in ("Stuhl_No_1", "lamp"))
    write_exr(other, read_exr(mixed) + 1)
    stamp = stamp_of("texture", {}, {})
    for file in (mixed, other):
        stamp.outputs[f"textures/{file.name}"] = sha256_of(file)
    path = stamp_path(built.asset.folder, 2, "texture")
    path.parent.mkdir(parents=True)
    write_stamp(path, stamp)
    mixed.write_bytes(other.read_bytes())
    (finding,) = validate(built.asset.root_layer)
    assert (finding.rule, finding.severity) == ("usdbrdf.LayerEdited", Severity.ERROR)
    assert finding.message == f"@{mixed}@ holds what was written into @{other}@."


def test_a_reference_that_leads_nowhere_is_found_once_and_nothing_is_printed(built, capfd):
    with edited(built.asset.edits_layer) as layer:
        prim = Sdf.CreatePrimInLayer(layer, "/room/prop")
        prim.referenceList.prependedItems = [Sdf.Reference("./gone.usda")]
    for photograph in built.scan.frames.image_paths:
        photograph.unlink()
    capfd.readouterr()
    findings = validate(built.asset.root_layer)
    assert capfd.readouterr() == ("", "")
    (missing,) = [f for f in findings if "gone.usda" in f.message]
    assert missing.rule == "usdValidation:CompositionErrorTest.CompositionError"
    assert (missing.site, missing.layer) == ("</room/prop>", f"@{built.asset.root_layer}@")
    (photographs,) = [f for f in findings if f.rule == "usdbrdf.MissingPhotograph"]
    assert photographs.message.endswith("does not exist. Nor do 2 more of its photographs.")


def test_the_root_layer_names_its_asset_too(built, capfd):
    folder, root = built.asset.folder, built.asset.root_layer
    assert main(["validate", str(root)]) == 0
    assert capfd.readouterr().err == f"{root}: no errors\n"
    for place in (built.asset.edits_layer, folder / "layers", folder / "gone.usda"):
        assert main(["validate", str(place)]) == 3
        told = capfd.readouterr().err
        assert f"{place}: there is no asset here. Name the folder" in told
        assert "[asset.missing]" in told


def test_what_is_no_layer_is_a_finding(tmp_path):
    (tmp_path / "x.usda").write_text("nonsense")
    (finding,) = validate(tmp_path / "x.usda")
    assert str(finding).endswith("[usd.Open]")
    assert has_errors([finding])


def test_a_layer_that_cannot_be_read_is_a_finding(built, capfd):
    with built.asset.edits_layer.open("a") as file:
        file.write('over "broken" {\n')
    findings = [f for f in validate(built.asset.root_layer) if f.rule == "usd.Open"]
    assert [f.layer for f in findings] == [f"@{built.asset.edits_layer}@"]
    assert "USD cannot open it" in str(findings[0])
    assert "Expected }" in str(findings[0])
    assert main(["validate", str(built.asset.folder)]) == 7
    told = capfd.readouterr()
    assert f"@{built.asset.edits_layer}@: USD cannot open it" in told.out
    assert told.err == ""


def test_a_missing_file_is_found_once(built):
    (built.asset.folder / "textures" / "lamp.lit.exr").unlink()
    (finding,) = validate(built.asset.root_layer)
    assert finding.severity is Severity.ERROR


def test_findings_are_those_of_the_files_as_they_are_now(built):
    edits = built.asset.edits_layer
    text = edits.read_text()
    opened = Sdf.Layer.FindOrOpen(str(edits))
    assert validate(built.asset.root_layer) == []
    edits.write_text(text.replace('over "room"', 'over "room" (variants = {string look = "no"})'))
    assert [f.rule for f in validate(built.asset.root_layer)] == ["usdbrdf.LookSelection"]
    edits.write_text(text)
    assert validate(built.asset.root_layer) == []
    assert opened


def test_rules_are_listed_once_each_with_a_description():
    rules = listed_rules()
    names = [rule.name for rule in rules]
    assert len(set(names)) == len(names)
    assert "usdbrdf.LookSelection" in names
    assert "usdShadeValidators:ShaderSdrCompliance" in names
    assert all(rule.description for rule in rules)


@pytest.mark.parametrize(("identifier", "known"), [("ND_image_color3", True), ("nonsense", False)])
def test_nodes_of_materialx_count_as_known(built, identifier, known):
    shader = "/room/geo/wall/mtl/wall/Node"
    opinion(built, shader, "info:id", Sdf.ValueTypeNames.Token, identifier)
    with edited(built.asset.edits_layer) as layer:
        prim = layer.GetPrimAtPath(shader)
        prim.specifier, prim.typeName = Sdf.SpecifierDef, "Shader"
    found = [f.rule for f in validate(built.asset.root_layer)]
    name = "usdShadeValidators:ShaderSdrCompliance.MissingShaderIdInRegistry"
    assert found == ([] if known else [name])


def test_what_a_package_names_is_looked_for_in_it(tmp_path):
    """Its thumbnail too, which only metadata name."""
    layer = Sdf.Layer.CreateNew(str(tmp_path / "one.usda"))
    prim = Sdf.CreatePrimInLayer(layer, "/one")
    layer.defaultPrim, prim.specifier = "one", Sdf.SpecifierDef
    inside = Sdf.AssetPath("./shown.png")
    prim.SetInfo("assetInfo", {"previews": {"thumbnails": {"default": {"defaultImage": inside}}}})
    layer.Save()
    (tmp_path / "shown.png").write_bytes(b"a picture")
    for name, members in (("whole", ["one.usda", "shown.png"]), ("lacking", ["one.usda"])):
        writer = Sdf.ZipFileWriter.CreateNew(str(tmp_path / f"{name}.usdz"))
        for member in members:
            writer.AddFile(str(tmp_path / member), member)
        writer.Save()
    (tmp_path / "shown.png").unlink()
    rules = {
        name: [f.rule for f in own_findings(Usd.Stage.Open(str(tmp_path / f"{name}.usdz")))]
        for name in ("whole", "lacking")
    }
    assert "usdbrdf.MissingTexture" not in rules["whole"]
    assert "usdbrdf.MissingTexture" in rules["lacking"]


def test_findings_for_programs(built, capsys):
    root, layer = built.asset.root_layer, built.asset.folder / "fixes.usda"
    assert main(["validate", str(built.asset.folder), "--json"]) == 0
    sound = {"asset": str(root), "findings": [], "fix": None}
    assert checked(capsys.readouterr().out, "validate") == sound
    opinion(built, "/room/cameras/capture", "exposure", Sdf.ValueTypeNames.Float, 1.0)
    assert main(["validate", str(built.asset.folder), "--json", "--fix", str(layer)]) == 7
    told = checked(capsys.readouterr().out, "validate")
    (finding,) = told["findings"]
    assert (finding["severity"], finding["rule"]) == ("error", "usdbrdf.CameraExposure")
    assert told["fix"] == {"layer": str(layer), "findings": [finding]}
