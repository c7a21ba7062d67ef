"""Sound assets have no findings; unsound ones say what is wrong."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from pxr import Sdf

from usdbrdf.stage.asset import ROLES
from usdbrdf.stage.schema import plugin_path
from usdbrdf.stage.validate import validate


@pytest.mark.parametrize("upto", ROLES)
@pytest.mark.parametrize("folder", ["room", "Zimmer é 椅子 (1)", 'a @ # ; [1] "x% <UDIM>'])
def test_an_asset_has_no_findings_after_any_stage(tmp_path, synthetic, upto, folder):
    scan = synthetic.make_scan(tmp_path / f"capture {folder}", unit=0.01, up_axis="Y")
    built = synthetic.build(tmp_path / folder, scan, upto=upto)
    assert validate(built.asset.root_layer) == []


def test_a_missing_texture_and_photograph_are_named(built):
    (built.asset.folder / "textures" / "lamp.lit.exr").unlink()
    built.scan.frames.image_paths[2].unlink()
    findings = "\n".join(validate(built.asset.root_layer))
    assert "lamp.lit.exr@ does not exist. [validate.missing]" in findings
    assert "frame 02 é.exr@ does not exist. [validate.missing]" in findings


def test_usds_own_validators_are_asked(built):
    edits = Sdf.Layer.FindOrOpen(str(built.asset.edits_layer))
    prim = Sdf.CreatePrimInLayer(edits, "/room/geo/wall")
    binding = Sdf.RelationshipSpec(prim, "material:binding:mine", custom=False)
    binding.targetPathList.explicitItems = [Sdf.Path("/room/mtl/wall"), Sdf.Path("/room/mtl/lamp")]
    edits.Save()
    findings = validate(built.asset.root_layer)
    assert any("</room/geo/wall" in f and "usdShadeValidators:" in f for f in findings)


def test_a_missing_sublayer_is_a_finding(built):
    built.asset.layer("shading").unlink()
    findings = "\n".join(validate(built.asset.root_layer))
    assert "shading.usda" in findings
    assert "[validate.composition]" in findings


def test_what_is_no_layer_is_a_finding(tmp_path):
    (tmp_path / "x.usda").write_text("nonsense")
    (finding,) = validate(tmp_path / "x.usda")
    assert finding.endswith("[validate.open]")


@pytest.mark.parametrize("schemas", ["", "known"])
def test_omniverse_finds_nothing(built, schemas):
    tool = shutil.which("omni_asset_validate", path=str(Path(sys.executable).parent))
    if not tool:
        pytest.skip("omniverse-asset-validator is not installed (extra dcc)")
    path = str(plugin_path()) if schemas else ""
    done = subprocess.run(
        [tool, str(built.asset.root_layer)],
        env={**os.environ, "PXR_PLUGINPATH_NAME": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
