"""Captures out of a repository whose large files Git LFS has not fetched."""

from __future__ import annotations

import pytest

from tests.scenes import make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.errors import InputRefused
from usdbrdf.options import IngestOptions

POINTER = """version https://git-lfs.github.com/spec/v1
oid sha256:be8618a943913ecba491fd8118e84e09b134e0cf6b83b7e4818ca4a90bcc8805
size 7406844
"""
SAID = r"a pointer of Git LFS, not the file itself\. Fetch it with 'git lfs pull'"


@pytest.mark.parametrize(("name", "rule"), [("mesh.ply", "mesh"), ("transforms.json", "document")])
def test_a_file_that_was_not_fetched_is_called_so(tmp_path, name, rule):
    made = make_capture(tmp_path / "room")
    (made.folder / name).write_text(POINTER)
    with pytest.raises(InputRefused, match=rf"{name}: {SAID}.*\[{rule}\.pointer\]$"):
        read_scan(made.folder, IngestOptions())


def test_frames_that_were_not_fetched_are_left_out(tmp_path):
    made = make_capture(tmp_path / "room")
    made.image(2).write_text(POINTER)
    scan = read_scan(made.folder, IngestOptions())
    assert len(scan.frames) == len(made.world_from_camera) - 1
    assert any("0002.exr" in said and "a pointer of Git LFS" in said for said in scan.warnings)


def test_a_document_by_whose_content_a_format_is_known_is_called_so(tmp_path):
    (tmp_path / "cameras.xml").write_text(POINTER)
    (tmp_path / "0001.jpg").write_bytes(b"")
    with pytest.raises(InputRefused, match=rf"cameras\.xml is {SAID}.*\[adapter\.none\]$"):
        read_scan(tmp_path, IngestOptions())
