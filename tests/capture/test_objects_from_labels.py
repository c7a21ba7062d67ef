"""Objects from labels, and from connectivity where there are none."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.scenes import make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.capture.mesh_frames import doubts_about_ids
from usdbrdf.capture.parts import label_table, objects_with_faces, segmentation
from usdbrdf.errors import InputRefused
from usdbrdf.model.mesh import ObjectName
from usdbrdf.options import IngestOptions
from usdbrdf.untrusted.mesh_files import FileMesh, mesh_from_file


def _squares(sides: list[float], **more) -> FileMesh:
    """Separate squares, whose triangles share no vertex number, only positions."""
    points = np.concatenate(
        [
            np.array([[0, 0, 0], [s, 0, 0], [s, s, 0], [0, 0, 0], [s, s, 0], [0, s, 0]])
            + np.array([10.0 * i, 0, 0])
            for i, s in enumerate(sides)
        ]
    )
    triangles = np.arange(len(points), dtype=np.int32).reshape(-1, 3)
    return FileMesh(points=points.astype(np.float32), triangles=triangles, **more)


def test_connected_parts_come_largest_first_and_the_small_ones_together():
    split = segmentation(_squares([0.05, 2, 1, 0.05]), None, table_path=None, min_area=0.01)
    assert [name.label for name in split.labels] == ["part_001", "part_002", "rest"]
    assert split.face_object.tolist() == [2, 2, 0, 0, 1, 1, 2, 2]


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_what_is_too_small_for_an_object_does_not_depend_on_the_unit(unit):
    sides = [unit * side for side in (0.005, 2, 1, 0.005)]
    split = segmentation(_squares(sides), None, table_path=None, min_area=None)
    assert [name.label for name in split.labels] == ["part_001", "part_002", "rest"]
    assert split.face_object.tolist() == [2, 2, 0, 0, 1, 1, 2, 2]


@pytest.mark.fault("G9")
def test_one_large_part_is_one_object():
    split = segmentation(_squares([2, 0.05]), None, table_path=None, min_area=0.01)
    assert split.labels == (ObjectName("scan"),)
    assert split.face_object.tolist() == [0] * 4


@pytest.mark.fault("G10")
def test_ids_may_be_sparse_and_negative(tmp_path):
    path = tmp_path / "objects.json"
    chair = {"id": 7, "name": "chair", "class_name": "seat"}
    path.write_text(json.dumps({"objects": [chair, {"id": 9, "directive": "lamp"}]}))
    labels = np.array([900000, 7, -5, 9, -1, 7])
    mesh = _squares([1, 1, 1], face_label=labels)
    split = segmentation(mesh, label_table(path), table_path=path, min_area=0.01)
    assert [split.labels[i] for i in split.face_object] == [
        ("object_900000", "", ""),
        ("chair", "seat", ""),
        ("unlabelled", "", ""),
        ("object_9", "", "lamp"),
        ("unlabelled", "", ""),
        ("chair", "seat", ""),
    ]


def test_labels_of_the_document_count_the_broken_faces_too(tmp_path):
    path = tmp_path / "objects.json"
    path.write_text('{"objects": [], "face_object_id": [1, 2, 3, 4, 5]}')
    kept = np.array([True, False, True, True, True])
    split = segmentation(
        _squares([1, 1], kept=kept), label_table(path), table_path=path, min_area=0.01
    )
    assert [name.label for name in split.labels] == ["object_1", "object_3", "object_4", "object_5"]


@pytest.mark.fault("G10")
def test_too_many_objects_are_no_objects():
    mesh = _squares([1.0] * 40_000, face_label=np.arange(80_000))
    with pytest.raises(InputRefused, match=r"80000 different.*65535.*\[objects.limit\]"):
        segmentation(mesh, None, table_path=None, min_area=0.01)


@pytest.mark.parametrize(
    "text",
    ["3", '{"objects": {}}', '{"objects": [{"id": "a"}]}', '{"objects": [{"id": true}]}',
     '{"objects": [{"id": 1, "name": 5}]}', '{"objects": [], "face_object_id": [0.5]}'],
)  # fmt: skip
def test_documents_of_another_shape_are_refused(tmp_path, text):
    (tmp_path / "objects.json").write_text(text)
    with pytest.raises(InputRefused, match=r"objects\.json: .*\[objects\.format\]$"):
        label_table(tmp_path / "objects.json")


def test_objects_without_faces_disappear():
    labels = (ObjectName("a"), ObjectName("b", "x"), ObjectName("c", "", "metal"))
    face_object, objects = objects_with_faces(np.array([2, 1, 2], np.int32), labels)
    assert face_object.tolist() == [1, 0, 1]
    found = [(o.label, o.class_name, o.directive) for o in objects]
    assert found == [("b", "x", ""), ("c", "", "metal")]


def test_a_directive_that_is_none_is_refused(tmp_path):
    path = tmp_path / "objects.json"
    path.write_text('{"objects": [{"id": 4, "directive": "gold"}]}')
    with pytest.raises(
        InputRefused, match=r"'gold' of object 4 is none of .*\[objects.directive\]$"
    ):
        label_table(path)


@pytest.mark.fault("G10")
def test_ids_that_count_from_another_number_are_told(tmp_path):
    """As the names are wrong then; a list of more names than are used is none."""
    made = make_capture(tmp_path / "scan")
    path = made.folder / "objects.json"
    document = json.loads(path.read_text())
    document["objects"].append({"id": 900, "name": "nowhere"})
    path.write_text(json.dumps(document))
    assert read_scan(made.folder, IngestOptions()).warnings == ()
    for row in document["objects"]:
        row["id"] += 1
    path.write_text(json.dumps(document))
    (told,) = read_scan(made.folder, IngestOptions()).warnings
    highest = len(made.names)
    assert told.startswith(
        "objects.json: faces have ids that it does not name (0), and it names ids that no face has "
        f"({highest}, 901)."
    )
    assert told.endswith("[objects.ids]")
    # A list of all classes there are, of which faces have some, and 0 for none.
    path.write_text(json.dumps({"objects": [{"id": k, "name": f"n{k}"} for k in range(1, 900)]}))
    table = label_table(path)
    few = np.resize(np.array([0, 3, 5, 7]), len(made.face_object))
    mesh = mesh_from_file(made.folder / "mesh.ply")
    assert list(doubts_about_ids(replace(mesh, face_label=few), table, path.name)) == []
