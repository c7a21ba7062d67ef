"""No document leads out of its folder."""

from __future__ import annotations

import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.files.paths import contained


@pytest.fixture
def root(tmp_path):
    root = tmp_path / "capture"
    (root / "images").mkdir(parents=True)
    (tmp_path / "secret").write_text("x")
    (root / "out").symlink_to(tmp_path)
    (root / "leak.exr").symlink_to(tmp_path / "secret")
    (root / "inside.exr").symlink_to("images/a.exr")
    (root / "loop").symlink_to("loop")
    return root


@pytest.mark.parametrize(
    "name",
    [
        "images/0001.exr",
        "./a.exr",
        "images/../b.exr",
        "not there/é 椅子 [1]@#;.exr",
        "..a/b",
        "inside.exr",
        "images/10:30.png",
        "<UDIM>.exr",
    ],
)
def test_inside(root, name):
    path = contained(root, name)
    assert path.is_absolute()
    assert path.is_relative_to(root)


def test_link_is_judged_by_its_target(root):
    assert contained(root, "inside.exr") == root / "images/a.exr"


@pytest.mark.parametrize(
    "name",
    [
        "../secret",
        "../../etc/passwd",
        "images/../../secret",
        "/etc/passwd",
        "~/x",
        "file:///etc/passwd",
        "file:/etc/passwd",
        "FILE:secret",
        "http://example.org/x.exr",
        "data:image/png;base64,AAAA",
        "\\\\server\\share\\x",
        "C:\\x.exr",
        "x" * 5000,
        "x/" * 2500,
        "images/" + "x" * 256,
        "frames/\ud800.exr",
        "c:/x.exr",
        "out/secret",
        "leak.exr",
        "",
        "a\0b",
        "loop/x/../../../secret",
    ],
)
def test_outside(root, name):
    with pytest.raises(InputRefused, match=r"\[paths\.outside\]$") as caught:
        contained(root, name)
    assert len(str(caught.value)) < 800
    assert "\0" not in str(caught.value)


def test_absolute_path_inside_is_refused_too(root):
    with pytest.raises(InputRefused, match="absolute"):
        contained(root, str(root / "images/a.exr"))


def test_root_may_itself_be_a_link(root, tmp_path):
    (tmp_path / "link").symlink_to(root)
    assert contained(tmp_path / "link", "images/a.exr") == root / "images/a.exr"
