"""Objects that ingest makes of a scan: what the stage, the summary and a copy say of them."""

from __future__ import annotations

import json

import pytest
from pxr import Usd

from tests.scenes import make_capture
from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.errors import UsageError
from usdbrdf.options import IngestOptions
from usdbrdf.pipeline import ingest


def _sources(asset):
    stage = Usd.Stage.Open(str(asset.root_layer))
    said = (prim.GetAttribute("usdBrdf:labelSource").Get() for prim in stage.Traverse())
    return {source for source in said if source is not None}


def test_segmented_objects_are_named_so_in_stage_summary_and_copy(tmp_path):
    capture = make_capture(tmp_path / "capture")
    asset = Asset.at(tmp_path / "asset")
    options = IngestOptions(objects="auto")
    result = ingest(capture.folder, asset, options, copy_to=tmp_path / "copy").summary
    assert result["objects_from"] == "segmented"
    assert result["objects"] == 8
    assert result["segmentation"] == {"planes": 6, "colours_on_planes": 0, "parts": 2}
    assert _sources(asset) == {"segmented"}
    assert read_provenance(asset.layer("scan"))["objects_from"] == "segmented"
    copied = json.loads((tmp_path / "copy/objects.json").read_text())["objects"]
    assert [item["name"] for item in copied[:1]] == ["plane_001"]
    again = ingest(tmp_path / "copy", Asset.at(tmp_path / "again"), IngestOptions()).summary
    assert (again["objects"], again["objects_from"]) == (8, "capture")


def test_labels_of_the_mesh_are_the_captures_own(tmp_path):
    capture = make_capture(tmp_path / "capture")
    (capture.folder / "objects.json").unlink()
    asset = Asset.at(tmp_path / "asset")
    ingest(capture.folder, asset, IngestOptions())
    assert _sources(asset) == {"capture"}  # mesh.ply has an object_id for each face


def test_a_word_that_is_no_file_is_refused():
    with pytest.raises(UsageError, match=r"expected auto.*\[usage.option\]"):
        IngestOptions(objects="automatic")
