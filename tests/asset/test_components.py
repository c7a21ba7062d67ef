"""The files of the objects are written in a time that grows as their number, not as its square."""

from __future__ import annotations

from pxr import Sdf

from tests.scenes import make_capture
from usdbrdf.asset.layers import interface
from usdbrdf.cli import main


def test_the_layer_that_all_objects_refer_to_is_read_once(tmp_path, monkeypatch):
    held = []
    write = interface.export

    def export(layer, path, *, folder):
        if layer.customLayerData["usdbrdf"]["role"] == "component":
            loaded = {Sdf.Layer.GetDisplayName(one) for one in Sdf.Layer.GetLoadedLayers()}
            held.append("scan.interface.usda" in loaded)
        write(layer, path, folder=folder)

    monkeypatch.setattr(interface, "export", export)
    room = make_capture(tmp_path / "room")
    assert main(["ingest", str(room.folder), "-o", str(tmp_path / "out")]) == 0
    assert held == [True] * len(room.names)
