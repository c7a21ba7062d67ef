"""Photographs that are no longer those that the capture was read with when a later step comes."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from tests.scenes import edited, make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.cli import main
from usdbrdf.errors import ImageRefused
from usdbrdf.files.frames import read_frame
from usdbrdf.files.images import encoded_jpeg, read_exr, write_exr
from usdbrdf.options import IngestOptions

COARSE = ("--texel-size", "0.3")


@pytest.fixture(scope="module")
def ingested(tmp_path_factory):
    """A capture and its asset after the first step; a test gets copies of both."""
    capture = make_capture(tmp_path_factory.mktemp("changing") / "scan")
    assert main(["ingest", str(capture.folder), "-o", str(capture.folder.parent / "room")]) == 0
    return capture


def _swap(capture):
    one, other = capture.image(3), capture.image(4)
    before = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(before)


def _shrink(capture):
    write_exr(capture.image(3), np.ascontiguousarray(read_exr(capture.image(3))[::2, ::2]))


def _brighten(capture):
    write_exr(capture.image(3), 2 * read_exr(capture.image(3)))


@pytest.mark.fault("C16")
@pytest.mark.parametrize("change", [_swap, _shrink, _brighten])
def test_a_step_takes_no_other_photographs_than_ingest_looked_at(
    change, ingested, tmp_path, capsys
):
    shutil.copytree(ingested.folder.parent, tmp_path / "work")
    capture = make_capture(tmp_path / "work" / "scan")
    room = str(tmp_path / "work" / "room")
    change(capture)
    capsys.readouterr()
    assert main(["texture", room, *COARSE]) == 3
    said = capsys.readouterr().err
    assert f"{capture.image(3)}: not the file that the capture was read with" in said
    assert "[input.changed]" in said
    # What the sentence says to do helps.
    assert main(["ingest", str(capture.folder), "-o", room, "-q"]) == 0
    assert main(["texture", room, "-q", *COARSE]) == 0


@pytest.mark.fault("C16")
def test_a_mask_that_changed_is_named_and_no_photograph_beside_it(tmp_path, capsys):
    """Of two lightings, in the one that was taken later; and one of its frames has no mask."""
    captures = [make_capture(tmp_path / name) for name in ("day", "night")]
    masks = tmp_path / "night" / "masks"
    masks.mkdir()
    white = np.full((24, 32, 3), 255, np.uint8)
    with edited(captures[1].manifest) as document:
        for i, frame in enumerate(document["frames"][1:], 1):
            frame["mask_path"] = f"masks/{i}.jpg"
            (masks / f"{i}.jpg").write_bytes(encoded_jpeg(white, 90))
    room = str(tmp_path / "room")
    assert main(["ingest", *(str(one.folder) for one in captures), "-o", room, "-q"]) == 0
    assert main(["texture", room, "-q", *COARSE]) == 0
    (masks / "3.jpg").write_bytes(encoded_jpeg(white - 9, 90))
    capsys.readouterr()
    assert main(["texture", room, *COARSE]) == 3
    assert f"{masks / '3.jpg'}: not the file" in capsys.readouterr().err


def test_pixels_that_are_not_there_are_not_read(tmp_path):
    capture = make_capture(tmp_path / "scan")
    frames = read_scan(capture.folder, IngestOptions()).frames
    _shrink(capture)
    read_frame(frames, 2)
    with pytest.raises(ImageRefused, match=r"0003.exr: 16 x 12 pixels, and 32 x 24 when"):
        read_frame(frames, 3)
