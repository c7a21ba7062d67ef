"""What people name that is no capture: the sentence says what lies there and what to do."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

DOCUMENTS = [
    ("castle.nvm", "NVM_V3\n\n11\n", "VisualSFM", "COLMAP"),
    ("bundle.rd.out", "# Bundle file v0.3\n2 9\n", "Bundler", "COLMAP"),
    ("cameras.sfm", '{"version": ["1", "2", "7"], "views": []}', "Meshroom", "ExportColmap"),
    ("castle.baf", "1\n11\n", "Meshroom", "ExportColmap"),
    ("sfm_data.json", '{"sfm_data_version": "0.3"}', "OpenMVG", "openMVG2Colmap"),
    ("renamed.json", '{"sfm_data_version": "0.3"}', "OpenMVG", "openMVG2Colmap"),
    ("reconstruction.json", '[{"cameras": {}, "shots": {}}]', "OpenSfM", "export_colmap"),
    ("trajectory.json", '{"class_name": "PinholeCameraTrajectory"}', "Open3D", "example"),
]


def _refused(path: Path) -> str:
    with pytest.raises(InputRefused) as refusal:
        read_scan(path, IngestOptions())
    said = str(refusal.value).replace(str(path), "")
    assert len(said) < 320
    return said


@pytest.mark.parametrize(("name", "content", "program", "how"), DOCUMENTS)
def test_cameras_of_other_programs_are_named_with_their_way_in(
    tmp_path, name, content, program, how
):
    document = tmp_path / name
    document.write_text(content)
    (tmp_path / "images").mkdir()
    (tmp_path / "images/0001.jpg").write_bytes(b"")
    for path in (document, tmp_path):
        said = _refused(path)
        assert f"{name} holds the cameras of {program}, which are not read." in said
        assert how in said


def test_a_document_that_names_no_program_is_none_of_theirs(tmp_path):
    (tmp_path / "run.out").write_text("all went well")
    document = tmp_path / "settings.json"
    document.write_text(json.dumps({"quality": "high"}))
    assert "neither pictures nor cameras" in _refused(tmp_path)
    assert "this is not a transforms.json" in _refused(document)


def test_photographs_alone_need_cameras(tmp_path):
    for i in range(3):
        (tmp_path / f"{i}.JPG").write_bytes(b"")
    said = _refused(tmp_path)
    assert "it holds 3 pictures, but nothing that says where the cameras stood" in said
    assert "COLMAP, Metashape, RealityScan" in said


def test_a_scan_without_cameras_needs_its_programs_document(tmp_path):
    (tmp_path / "textured.obj").write_text("")
    (tmp_path / "0.jpg").write_bytes(b"")
    said = _refused(tmp_path)
    assert "it holds 1 picture and the mesh textured.obj, but nothing" in said
    assert "Bring the document that the scanning program writes of its cameras" in said


def test_the_folder_above_a_capture_names_the_one_to_ask_for(tmp_path):
    (tmp_path / "export/scene").mkdir(parents=True)
    (tmp_path / "export/scene/transforms.json").write_text("{}")
    said = _refused(tmp_path)
    assert said.startswith(": no capture itself, but export/scene/ in it is one (transforms). Name")
