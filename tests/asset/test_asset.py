"""Where things lie in an asset folder."""

import pytest
from pxr import Sdf

from usdbrdf.asset.layout import Asset, path_in_asset, path_in_layer
from usdbrdf.errors import InputRefused


@pytest.mark.parametrize(
    ("folder", "name"),
    [("room", "room"), ("my room (2)", "my_room_2"), ("3D", "_3D"), ("房间", "asset"), ("é", "e")],
)
def test_the_name_comes_from_the_folder(tmp_path, folder, name):
    asset = Asset.at(tmp_path / folder)
    assert asset.name == name
    assert asset.root_layer == tmp_path / folder / f"{name}.usda"
    assert Sdf.Path.IsValidIdentifier(asset.name)


def test_a_renamed_folder_keeps_the_names_of_its_files(built):
    moved = built.asset.folder.rename(built.asset.folder.with_name("lounge"))
    assert Asset.at(moved).name == "room"
    assert Asset.at(moved).root_layer.is_file()


@pytest.mark.parametrize("name", ["two\nlines", "tab\there", "back\\slash", "a:SDF_FORMAT_ARGS:b"])
def test_a_folder_that_usd_cannot_name_is_refused(tmp_path, name):
    with pytest.raises(InputRefused, match=r"Choose another folder.+\[stage\.asset_path\]"):
        Asset.at(tmp_path / name)


def test_a_damaged_scan_layer_does_not_hide_the_folder(tmp_path):
    (tmp_path / "room" / "layers").mkdir(parents=True)
    (tmp_path / "room" / "layers" / "scan.usdc").write_bytes(b"PXR-USDC and then nothing")
    assert Asset.at(tmp_path / "room").name == "room"


def test_the_places_of_the_files(tmp_path):
    asset = Asset.at(tmp_path / "room")
    layers = tmp_path / "room" / "layers"
    assert asset.layer("scan") == layers / "scan.usdc"
    assert asset.layer("material") == layers / "material.usda"
    assert asset.uv_layer == layers / "texturing_uv.usdc"
    assert asset.texture("chair", "lit") == "textures/chair.lit.exr"
    assert path_in_asset(path_in_layer("textures/chair.lit.exr")) == "textures/chair.lit.exr"
