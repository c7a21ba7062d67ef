"""What holds for every layer: header, provenance, equal bytes, no absolute path, whole files."""

import errno
import hashlib
import os
import re
import resource
from dataclasses import replace

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom

from usdbrdf.asset.header import Provenance, StageHeader, new_layer, read_header, read_provenance
from usdbrdf.asset.layers.author import export
from usdbrdf.asset.layers.scan_layer import check_root
from usdbrdf.asset.layout import ROLES, Asset
from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict, UsdBrdfError


def layer_files(asset):
    return sorted([asset.root_layer, asset.edits_layer, *(asset.folder / "layers").iterdir()])


def digests(asset):
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in layer_files(asset)}


def test_all_layers_carry_the_same_header(built):
    for path in layer_files(built.asset):
        assert read_header(path) == built.header
        assert Sdf.Layer.FindOrOpen(str(path)).timeCodesPerSecond == 24
        assert read_provenance(path)["role"]


def test_provenance_keeps_parameters_and_input_hashes(built):
    facts = read_provenance(built.asset.layer("scan"))
    assert facts["parameters"]["quantile"] == 0.5
    assert facts["inputs"]["mesh"] == "0" * 64
    assert facts["counts"]["degenerate_faces"] == 2
    assert facts["radiometric"] is True


def test_provenance_takes_whatever_options_are_made_of(tmp_path):
    parameters = {
        "none": None, "flag": np.bool_(True), "count": np.int64(2**40), "size": np.float32(0.5),
        "list": [1, 2.5], "names": ("a", "ü"), "empty": [], "nested": {"path/x y": True},
    }  # fmt: skip
    layer = new_layer(
        StageHeader(name="room"), Provenance(role="x", version="1", parameters=parameters)
    )
    Sdf.CreatePrimInLayer(layer, "/room")
    export(layer, tmp_path / "x.usda", folder=tmp_path)
    stored = read_provenance(tmp_path / "x.usda")["parameters"]
    assert "none" not in stored
    assert stored["flag"] is True
    assert stored["count"] == 2**40
    assert list(stored["list"]) == [1, 2.5]
    assert list(stored["names"]) == ["a", "ü"]
    assert list(stored["empty"]) == []
    assert stored["nested"]["path/x y"] is True


def test_the_same_values_give_the_same_bytes(built, synthetic, tmp_path):
    before = digests(built.asset)
    for role in ROLES:
        built.write_layer(role)
    assert digests(built.asset) == before
    # The same again, in another place: nothing of the machine is in the files.
    folder = tmp_path / "elsewhere"
    other = synthetic.build(folder / "out" / "room", synthetic.make_scan(folder / "capture"))
    assert digests(other.asset) == before


def test_no_file_names_a_place_on_this_machine(built, tmp_path):
    for path in layer_files(built.asset):
        text = Sdf.Layer.FindOrOpen(str(path)).ExportToString()
        assert str(tmp_path) not in text
        assert "@/" not in text


def test_the_root_holds_layers_only_and_reads_in_order(built):
    root = Sdf.Layer.FindOrOpen(str(built.asset.root_layer))
    assert list(root.subLayerPaths) == [
        "./edits.usda",
        "./layers/material.interface.usda",
        "./layers/shading.interface.usda",
        "./layers/texturing.interface.usda",
        "./layers/scan.interface.usda",
    ]
    (prim,) = root.rootPrims
    assert prim.path == "/room"
    assert not prim.nameChildren
    assert not prim.properties
    (payload,) = prim.payloadList.prependedItems
    contents = Sdf.Layer.FindRelativeToLayer(root, payload.assetPath) or Sdf.Layer.FindOrOpen(
        root.ComputeAbsolutePath(payload.assetPath)
    )
    assert list(contents.subLayerPaths) == [
        "./material.usda",
        "./shading.usda",
        "./texturing.usda",
        "./scan.usdc",
        "./scan.interface.usda",
    ]


def test_a_capture_in_other_units_needs_another_folder(built):
    check_root(built.asset, built.header)
    check_root(built.asset, replace(built.header, end=99.0))
    check_root(Asset.at(built.asset.folder.with_name("new")), built.header)
    for other in (replace(built.header, meters_per_unit=0.01), replace(built.header, up_axis="Y")):
        with pytest.raises(OwnershipConflict, match=r"new folder.+\[ownership\.units\]"):
            check_root(built.asset, other)


@pytest.mark.parametrize("upto", ROLES)
def test_the_asset_composes_after_every_stage(tmp_path, synthetic, upto):
    scan = synthetic.make_scan(tmp_path / "capture")
    built = synthetic.build(tmp_path / "room", scan, upto=upto)
    stage = Usd.Stage.Open(str(built.asset.root_layer))
    assert not stage.GetCompositionErrors()
    assert stage.GetDefaultPrim().GetPath() == "/room"
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    pending = [read_provenance(built.asset.layer(role)).get("state") for role in ROLES]
    done = ROLES.index(upto) + 1
    assert pending == [None] * done + ["pending"] * (len(ROLES) - done)


@pytest.mark.fault("R1")
@pytest.mark.parametrize("role", ROLES)
def test_a_disk_that_is_full_leaves_the_old_file(built, role):
    path = built.asset.layer(role)
    before = path.read_bytes()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        # The kernel refuses every byte beyond this, as a full disk would.
        resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, hard))
        with pytest.raises(EnvironmentFailure, match="could not be written completely"):
            built.write_layer(role)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == before
    assert not [p for p in path.parent.iterdir() if p.name.startswith(".tmp-")]


def test_a_layer_that_does_not_compose_is_not_published(tmp_path):
    layer = new_layer(StageHeader(name="room"), Provenance(role="scan", version="1"))
    prim = Sdf.CreatePrimInLayer(layer, "/room")
    prim.referenceList.prependedItems = [Sdf.Reference("./missing.usda")]
    with pytest.raises(UsdBrdfError, match=r"missing\.usda.+\[stage\.composition\]"):
        export(layer, tmp_path / "scan.usda", folder=tmp_path)
    assert not list(tmp_path.iterdir())


DAMAGED = "what a disk gave instead of it"


def export_beside(tmp_path, name):
    """Export a layer that references another, which cannot be composed."""
    layer = new_layer(StageHeader(name="room"), Provenance(role="scan", version="1"))
    prim = Sdf.CreatePrimInLayer(layer, "/room")
    prim.referenceList.prependedItems = [Sdf.Reference(f"./{name}")]
    try:
        export(layer, tmp_path / "scan.usda", folder=tmp_path)
    finally:
        assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["neighbour.usda", "half  a@room.usda", "@@r@.usdc", "all.usdz"])
def test_a_layer_whose_neighbour_is_damaged_is_refused(tmp_path, name):
    (tmp_path / name).write_text(DAMAGED)
    with pytest.raises(InputRefused, match=rf"{re.escape(name)}: USD .+\[stage\.input\]$"):
        export_beside(tmp_path, name)


@pytest.mark.fault("R1")
@pytest.mark.parametrize("gone", [True, False])
def test_a_layer_whose_neighbour_cannot_be_read_may_be_written_later(tmp_path, monkeypatch, gone):
    """The disk fails once more, or not."""
    neighbour = tmp_path / "neighbour.usda"
    neighbour.write_text(DAMAGED)

    def read(file):
        if gone:
            raise OSError(errno.EIO, os.strerror(errno.EIO), file)
        neighbour.write_text("#usda 1.0\n")

    monkeypatch.setattr("usdbrdf.asset.layers.author.sha256_of", read)
    with pytest.raises(EnvironmentFailure, match=r"neighbour\.usda: .+\[environment\.io\]"):
        export_beside(tmp_path, neighbour.name)
