"""Frames that come later: texturing goes on, and makes what it would have made from the start."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import usdbrdf
from tests.scenes import make_capture
from usdbrdf.capture.adapters import read_scan
from usdbrdf.files.images import read_exr, write_exr
from usdbrdf.texturing import earlier

NUM_FRAMES, FIRST = 12, 9


@pytest.fixture
def made(tmp_path):
    return make_capture(tmp_path / "scan", frames=NUM_FRAMES, subdivisions=1, noise=0.1)


def _textured(made, out, order, capsys, texel_size=0.2):
    """Summary and messages of texturing with these frames of the capture, in this order."""
    document = json.loads(made.manifest.read_text())
    frames = sorted(document["frames"], key=lambda frame: frame["file_path"])
    given = made.folder / "given.json"
    if not given.exists():
        given.write_text(json.dumps(frames))
    document["frames"] = [json.loads(given.read_text())[i] for i in order]
    made.manifest.write_text(json.dumps(document))
    capsys.readouterr()
    with usdbrdf.working_on(out) as asset:
        usdbrdf.ingest(made.folder, asset, usdbrdf.IngestOptions())
        options = usdbrdf.TextureOptions(texel_size=texel_size)
        return usdbrdf.texture(asset, options).summary, capsys.readouterr().err


def _maps(out):
    return {file.name: file.read_bytes() for file in sorted((out / "textures").iterdir())}


def test_what_comes_later_gives_the_bytes_of_all_at_once(made, tmp_path, capsys):
    old, new = list(range(FIRST)), list(range(FIRST, NUM_FRAMES))
    _textured(made, tmp_path / "twice", old, capsys)
    first = _maps(tmp_path / "twice")
    # Later frames count as last, wherever the capture lists them.
    order = [*new[:1], *old[:4], *new[1:], *old[4:]]
    _, said = _textured(made, tmp_path / "twice", order, capsys)
    assert f"goes on from the statistics of {FIRST} frames" in said
    _textured(made, tmp_path / "once", old + new, capsys)
    assert _maps(tmp_path / "twice") == _maps(tmp_path / "once") != first


def test_texel_sizes_stay_where_frames_only_came(made, tmp_path, capsys):
    out = tmp_path / "out"
    before, _ = _textured(made, out, range(FIRST), capsys, None)
    after, said = _textured(made, out, range(NUM_FRAMES), capsys, None)
    anew, _ = _textured(made, tmp_path / "anew", range(NUM_FRAMES), capsys, None)
    assert "goes on" in said
    assert after["texel_size"] == before["texel_size"] != anew["texel_size"]
    assert after["texels"] == before["texels"]


def test_a_frame_that_changed_or_went_means_all_from_the_start(made, tmp_path, capsys):
    out = tmp_path / "out"
    _textured(made, out, range(NUM_FRAMES), capsys)
    _, said = _textured(made, out, range(1, NUM_FRAMES), capsys)
    assert "goes on" not in said
    write_exr(made.image(3), np.float32(1.125) * read_exr(made.image(3)))
    _, said = _textured(made, out, range(1, NUM_FRAMES), capsys)
    assert "goes on" not in said
    _textured(made, tmp_path / "anew", range(1, NUM_FRAMES), capsys)
    assert _maps(out) == _maps(tmp_path / "anew")


def test_frames_through_another_lens_are_others(made):
    frames = read_scan(made.folder, usdbrdf.IngestOptions()).frames
    darker = replace(frames, vignetting=(-0.2, 0.0))
    of_lens, of_none = (earlier._hashes_of_frames(some) for some in (darker, frames))
    assert not set(of_lens) & set(of_none)


def test_damaged_statistics_are_as_good_as_none(made, tmp_path, capsys):
    out = tmp_path / "out"
    _textured(made, out, range(FIRST), capsys)
    (kept,) = (out / ".usdbrdf" / "cache").glob("texture-statistics-*.npz")
    data = bytearray(kept.read_bytes())
    data[len(data) // 2] ^= 1
    kept.write_bytes(data)
    _, said = _textured(made, out, range(NUM_FRAMES), capsys)
    assert "goes on" not in said
    _textured(made, tmp_path / "anew", range(NUM_FRAMES), capsys)
    assert _maps(out) == _maps(tmp_path / "anew")
