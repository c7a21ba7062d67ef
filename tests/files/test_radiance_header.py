"""What headers of Radiance files say, byte by byte."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from usdbrdf.errors import ImageRefused
from usdbrdf.files.radiance_header import factors_of_hdr, primaries_of_hdr

END = b"\n\n-Y 1 +X 1\n\x80\x80\x80\x80"


def hdr(tmp_path: Path, *lines: bytes, first: bytes = b"#?RADIANCE", end: bytes = END) -> Path:
    file = tmp_path / "a.hdr"
    file.write_bytes(b"\n".join([first, *lines]) + end)
    return file


@pytest.mark.parametrize(
    ("lines", "factors"),
    [
        ([], (1, 1, 1)),
        ([b"EXPOSURE=4"], (4, 4, 4)),
        ([b"EXPOSURE= 4.0 ", b"EXPOSURE=.5"], (2, 2, 2)),
        ([b"COLORCORR=1 2 4", b"EXPOSURE=3", b"COLORCORR= 2 1 1"], (6, 6, 12)),
        # What says nothing, or nothing that light can be divided by.
        ([b"EXPOSURE=0", b"EXPOSURE=-2", b"COLORCORR=1 0 1"], (1, 1, 1)),
        ([b"EXPOSURE=nan", b"EXPOSURE=inf", b"EXPOSURE=two", b"EXPOSURE="], (1, 1, 1)),
        ([b"EXPOSURE=2 3", b"COLORCORR=2 3 4 5"], (1, 1, 1)),
        ([b"exposure=2", b"# EXPOSURE=2", b"VIEW=EXPOSURE=2"], (1, 1, 1)),
        ([b"PRIMARIES=2 3 4"], (1, 1, 1)),
    ],
)
def test_factors_multiply(tmp_path: Path, lines: list[bytes], factors: tuple[float, ...]):
    assert factors_of_hdr(hdr(tmp_path, *lines)).tolist() == pytest.approx(list(factors))
    crlf = [line + b"\r" for line in lines]
    file = hdr(tmp_path, *crlf, first=b"#?X\r", end=b"\n\r\n-Y 1 +X 1\r\n")
    assert factors_of_hdr(file).tolist() == pytest.approx(list(factors))


def test_pixels_are_no_header(tmp_path: Path):
    after = END + b"\nEXPOSURE=8\n"
    assert (factors_of_hdr(hdr(tmp_path, b"EXPOSURE=2", end=after)) == 2).all()


def test_other_files_state_nothing(tmp_path: Path):
    stated = [b"EXPOSURE=4", b"PRIMARIES=.64 .33 .3 .6 .15 .06 .31 .33"]
    for first in (b"#RADIANCE", b"?#RADIANCE", b"\x89PNG", b""):
        file = hdr(tmp_path, *stated, first=first)
        assert (factors_of_hdr(file) == 1).all()
        assert primaries_of_hdr(file) == ()
    file.write_bytes(b"#")
    assert (factors_of_hdr(file) == 1).all()
    # Of whichever program, and however long its header is, within reason.
    long = [b"# " + b"x" * 997] * 64
    assert (factors_of_hdr(hdr(tmp_path, *long, *stated, first=b"#?AnyOther")) == 4).all()
    longer = [b"# " + b"x" * 997] * 80
    assert (factors_of_hdr(hdr(tmp_path, *longer, *stated)) == 1).all()


PRIMARIES = (0.64, 0.33, 0.29, 0.6, 0.15, 0.06, 0.333, 0.334)


@pytest.mark.parametrize(
    ("lines", "found"),
    [
        ([PRIMARIES], PRIMARIES),
        ([PRIMARIES[::-1], PRIMARIES], PRIMARIES),  # the last, of whoever wrote it anew
        ([], ()),
        ([(0.0,) * 8], ()),
        ([(0.0,) * 7 + (0.3,)], (0.0,) * 7 + (0.3,)),
        ([PRIMARIES[:7]], ()),
        ([(*PRIMARIES, 0.1)], ()),
    ],
)
def test_primaries_are_eight_numbers_of_which_some_is_not_zero(
    tmp_path: Path, lines: list[tuple[float, ...]], found: tuple[float, ...]
):
    written = [b"PRIMARIES= " + " ".join(map(str, line)).encode() for line in lines]
    file = hdr(tmp_path, b"EXPOSURE=2", *written, b"COLORCORR=1 1 3")
    assert primaries_of_hdr(file) == found
    np.testing.assert_allclose(factors_of_hdr(file), (2, 2, 6))


@pytest.mark.parametrize("said", [b"GAMMA=1", b"GAMMA= 1.000000", b"GAMMA=none", b"# GAMMA=2.2"])
def test_what_is_not_gamma_corrected_is_radiance(tmp_path: Path, said: bytes):
    assert (factors_of_hdr(hdr(tmp_path, said, b"EXPOSURE=2")) == 2).all()


@pytest.mark.parametrize("said", [b"GAMMA=2.2", b"GAMMA=0.4545"])
def test_what_is_gamma_corrected_is_refused(tmp_path: Path, said: bytes):
    with pytest.raises(ImageRefused, match=r"states GAMMA=.*no radiance.*\[image.gamma\]"):
        factors_of_hdr(hdr(tmp_path, said))


@pytest.mark.parametrize("said", [b"0", b"-2.2", b"nan", b"inf", b"-inf", b"1e999"])
def test_a_gamma_that_nothing_can_be_corrected_by_is_told_as_such(tmp_path: Path, said: bytes):
    with pytest.raises(ImageRefused, match=r"which nothing can be corrected by.*\[image.gamma\]"):
        factors_of_hdr(hdr(tmp_path, b"GAMMA=" + said))
