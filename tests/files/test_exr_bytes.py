"""A picture is all there or not at all, whichever of its writes fails."""

from __future__ import annotations

import struct

import numpy as np
import OpenImageIO as oiio
import pytest

from tests.fault_injection import run_watched
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files import images
from usdbrdf.files.exr_bytes import lists_its_chunks
from usdbrdf.files.images import write_exr
from usdbrdf.files.published_images import write_texture

UNWRITTEN = """
import errno, itertools, sys
from pathlib import Path
sys.path.insert(0, "benchmarks")
from system_calls import can_watch, run_watched
import numpy as np
from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.images import write_exr, write_preview_png
if not can_watch():
    sys.exit(77)
folder = Path(sys.argv[1])
pixels = np.random.default_rng(0).random((70, 80, 3), dtype=np.float32)
works = {
    "a.exr": lambda file: write_exr(file, pixels),
    "b.png": lambda file: write_preview_png(file, (pixels * 255).astype(np.uint8)),
}
for name, work in works.items():
    file = folder / name

    def write():
        try:
            work(file)
        except EnvironmentFailure:
            return 4
        return 0

    assert run_watched(write, ("lock",), folder, lambda call: None) == 0
    whole = file.read_bytes()
    for number in itertools.count():
        file.unlink()
        passed = itertools.count()
        answer = lambda call: errno.EDQUOT if next(passed) == number else None
        status = run_watched(write, ("write",), folder, answer)
        if next(passed) <= number:
            break
        print(name, status, file.exists())
        file.write_bytes(whole)
"""


@pytest.mark.fault("R1")
def test_whichever_write_of_a_picture_fails_none_is_made(tmp_path):
    """Also the last one of an EXR, the list of its chunks, which its library does not look at."""
    done = run_watched("-c", UNWRITTEN, tmp_path, timeout_s=120)
    found = {tuple(line.split()) for line in done.stdout.splitlines()}
    assert found == {(name, "4", "False") for name in ("a.exr", "b.png")}


@pytest.mark.fault("R1")
@pytest.mark.parametrize("kept", [0, 1, 4])
def test_an_exr_without_its_list_of_chunks_is_not_published(tmp_path, monkeypatch, kept):
    """Blocks of it stay as they were made room for, also where all others were written."""
    path, pixels = tmp_path / "a.exr", np.ones((160, 8, 3), np.float32)
    write_exr(path, pixels)
    whole = path.read_bytes()
    assert lists_its_chunks(path)
    # ZIP: 16 lines a chunk, each of them an offset of eight bytes; the first leads behind all ten.
    begin = next(i for i in range(len(whole)) if whole[i : i + 8] == struct.pack("<Q", i + 80))
    damaged = whole[: begin + 8 * kept] + bytes(80 - 8 * kept) + whole[begin + 80 :]

    def write(target, staged, *rest):
        write_image(target, staged, *rest)
        staged.write_bytes(damaged)

    write_image = images.write_image
    monkeypatch.setattr(images, "write_image", write)
    with pytest.raises(EnvironmentFailure, match=r"does not read back.+\[image\.write\]$"):
        write_exr(path, pixels)
    assert path.read_bytes() == whole
    (tmp_path / "b.exr").write_bytes(damaged)
    assert not lists_its_chunks(tmp_path / "b.exr")
    np.testing.assert_array_equal(images.read_exr(tmp_path / "b.exr"), pixels)  # tells nothing


@pytest.mark.parametrize("tiled", [False, True])
def test_lists_of_lines_and_of_tiles_with_smaller_copies(tmp_path, tiled):
    path = tmp_path / "a.exr"
    write_exr(path, np.ones((300, 200, 3), np.float32))
    if tiled:
        write_texture(tmp_path / "b.exr", path)
        path = tmp_path / "b.exr"
    assert lists_its_chunks(path)
    assert bool(oiio.ImageInput.open(str(path)).spec().tile_width) == tiled
    path.write_bytes(path.read_bytes()[:1000])
    assert not lists_its_chunks(path)
    path.write_bytes(b"no EXR")
    assert lists_its_chunks(path)
