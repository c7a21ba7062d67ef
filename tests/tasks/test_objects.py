"""Objects that ingest makes of a scan: what the stage, the summary and a copy say of them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pxr import Usd

from tests.lens_scenes import capture_through
from tests.scenes import make_capture, write_ply
from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layout import Asset
from usdbrdf.cli import main
from usdbrdf.errors import UsageError
from usdbrdf.options import IngestOptions, InspectOptions
from usdbrdf.pipeline import ingest
from usdbrdf.tasks import inspect as inspecting


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


def test_inspect_finds_the_objects_that_ingest_makes_and_the_captures_own_faces(tmp_path, capsys):
    """A leaf in the middle of the room, seen from both sides, has a second skin in the asset."""
    capture = make_capture(tmp_path / "capture")
    leaf = np.array(
        [[1.2, 1.5, 0.9], [2.8, 1.5, 0.9], [2.8, 1.5, 1.7], [1.2, 1.5, 1.7]], np.float32
    )
    points, n = np.concatenate([capture.points, leaf]), len(capture.points)
    triangles = np.concatenate([capture.triangles, [[n, n + 1, n + 2], [n, n + 2, n + 3]]])
    labels = np.concatenate([capture.face_object, [2, 2]])
    write_ply(capture.folder / "mesh.ply", points, triangles.astype(np.int32), labels)
    options = IngestOptions(objects="auto")
    made = ingest(capture.folder, Asset.at(tmp_path / "asset"), options).summary
    assert made["counts"]["faces_of_two_sides"] > 0
    capsys.readouterr()
    assert main(["inspect", str(capture.folder), "--objects", "auto", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["objects"]) == made["objects"]
    assert (told["mesh"]["vertices"], told["mesh"]["faces"]) == (len(points), len(triangles))


def test_inspect_develops_the_frames_alone_that_tell_colours(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap")
    made = capture_through(tmp_path / "room", "OPENCV", frames=40)
    developed, develop = [], inspecting.developed_in

    def counted(frames, views, folder):
        developed.append(len(frames))
        return develop(frames, views, folder)

    monkeypatch.setattr(inspecting, "developed_in", counted)
    found = inspecting.inspect(made.folder, InspectOptions(objects="auto"))
    assert found.refusals == ()
    assert developed == [16, 32]


@pytest.mark.parametrize("option", ["--refine-poses", "--vignetting=report", "--exposure=stated"])
def test_inspect_offers_nothing_that_it_does_not_do(tmp_path, option, capsys):
    capture = make_capture(tmp_path / "capture")
    assert main(["inspect", str(capture.folder), option]) == 2
    assert option.partition("=")[0] in capsys.readouterr().err


def test_a_word_that_is_no_file_is_refused():
    with pytest.raises(UsageError, match=r"expected auto.*\[usage.option\]"):
        IngestOptions(objects="automatic")
