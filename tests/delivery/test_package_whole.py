"""The asset with all its variants as one USDZ; and that no look holds nodes that nothing reads."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Usd, UsdShade

from tests.delivery.packing import extracted, members, packed, surfaces_of
from usdbrdf.asset.header import read_header
from usdbrdf.asset.layers.scan_layer import write_pending_layer
from usdbrdf.delivery.package import stage_in_look
from usdbrdf.errors import UsageError
from usdbrdf.validation.validate import own_findings


def test_every_look_is_there(room, tmp_path):
    output = packed(room, tmp_path, whole=True)
    names = members(output)
    assert names[0] == "room.usdc"
    assert {"layers/material.usda", "layers/scan.usdc", "textures/lamp.lit.exr"} <= {*names}
    assert not [name for name in names if "frame" in name or name.startswith("photographs")]
    stage = Usd.Stage.Open(str(output))
    looks = stage.GetDefaultPrim().GetVariantSet("look")
    here = stage_in_look(room.asset, "shaded")
    ours = here.GetDefaultPrim().GetVariantSet("look")
    assert looks.GetVariantNames() == ours.GetVariantNames()
    before = surfaces_of(here)
    for name, surface in surfaces_of(extracted(output, tmp_path / "x")).items():
        assert np.array_equal(surface.material.diffuse, before[name].material.diffuse)
        assert np.array_equal(surface.material.emission, before[name].material.emission)
    # What runs our rules on any stage finds no layer missing that lies in the package.
    assert own_findings(Usd.Stage.Open(str(output))) == []
    assert packed(room, tmp_path, "again.usdz", whole=True).read_bytes() == output.read_bytes()


@pytest.mark.parametrize(
    "options", [{"look": "lit"}, {"textures": "png"}, {"max_size": 4}, {"profile": "arkit"}]
)
def test_what_is_for_one_look_is_refused(room, tmp_path, options):
    with pytest.raises(UsageError, match=r"package\.whole"):
        packed(room, tmp_path, whole=True, **options)


def test_no_node_is_read_by_nobody(room):
    stage = stage_in_look(room.asset, "shaded")
    nodes = [prim for prim in stage.Traverse() if prim.IsA(UsdShade.Shader)]
    sources = {
        source.GetPrim()
        for prim in stage.Traverse()
        for attribute in prim.GetAttributes()
        for source in map(
            stage.GetPrimAtPath, (p.GetPrimPath() for p in attribute.GetConnections())
        )
    }
    assert nodes
    assert [prim.GetPath() for prim in nodes if prim not in sources] == []


def test_a_package_of_an_unfinished_asset_says_so(room, tmp_path, capsys):
    layer = room.asset.layer("material")
    write_pending_layer(layer, "material", read_header(room.asset.layer("scan")))
    for options in ({"whole": True}, {"look": "lit"}):
        packed(room, tmp_path, **options)
        said = capsys.readouterr().err
        assert "room.usdz: the step fit was not run; the package lacks what" in said
