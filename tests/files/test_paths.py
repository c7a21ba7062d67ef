"""No document leads out of its folder."""

from __future__ import annotations

import errno
import os
import re
from pathlib import Path

import pytest

from usdbrdf.capture.formats.named_pictures import path_in_capture
from usdbrdf.errors import EnvironmentFailure, InputRefused, OwnershipConflict
from usdbrdf.files.paths import contained, files_below, inside, seen_of
from usdbrdf.files.tables import beginning_of, files_of
from usdbrdf.options import IngestOptions


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


@pytest.mark.fault("S1")
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


@pytest.mark.parametrize(("name", "allowed"), [("shared", True), ("shared-secret", False)])
def test_what_is_allowed_is_a_folder_and_not_the_beginning_of_a_name(root, tmp_path, name, allowed):
    for folder in ("shared", "shared-secret"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.exr").touch()
    options = IngestOptions(allow_outside=(tmp_path / "shared",))
    candidate = f"../{name}/a.exr"
    if allowed:
        assert path_in_capture(root, candidate, options) == tmp_path / name / "a.exr"
    else:
        with pytest.raises(InputRefused, match=r"\[paths\.outside\]$"):
            path_in_capture(root, candidate, options)


def test_links_that_stay_inside_are_written_through(root, tmp_path):
    (root / "maps").symlink_to("images")
    for place in (root, root / "maps", root / "maps/not there", root / "images/x"):
        assert inside(root, place) == place
    (tmp_path / "link").symlink_to(root)
    assert inside(tmp_path / "link", tmp_path / "link/maps") == tmp_path / "link/maps"


@pytest.mark.parametrize("name", ["out", "out/not there", "leak.exr", "images/../out"])
def test_links_that_lead_out_are_not(root, name):
    with pytest.raises(OwnershipConflict, match=r"leads out of .+\[ownership\.link\]$"):
        inside(root, root / name)


def test_what_systems_and_editors_leave_is_not_part_of_a_folder(tmp_path):
    kept = ["a.json", "b/.hidden.exr", "b/c.exr", "notes.txt"]
    litter = [".DS_Store", "b/.DS_Store", "b/._c.exr", "Thumbs.db", "a.json~", "desktop.ini"]
    for name in (*kept, *litter, "own/d.exr"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = files_below(tmp_path, without=tmp_path / "own")
    assert [path.relative_to(tmp_path).as_posix() for path in found] == kept


@pytest.mark.parametrize("way", ["relative", "through a link"])
def test_what_is_left_out_of_a_folder_is_however_both_are_named(way, tmp_path, monkeypatch):
    for name in ("room/a.json", "room/own/b.json"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "link").symlink_to(tmp_path / "room")
    folder = Path("room") if way == "relative" else tmp_path / "link"
    assert files_below(folder, without=folder / "own") == [folder / "a.json"]
    assert files_below(folder, without=tmp_path / "room" / "own") == [folder / "a.json"]


def test_what_systems_leave_beside_files_is_not_seen(tmp_path):
    for name in (".DS_Store", "._a.ply", ".hidden", "Thumbs.db", "b.ply", "a.ply", "a.b.ply"):
        (tmp_path / name).touch()
    assert [p.name for p in seen_of(tmp_path.iterdir())] == ["a.b.ply", "a.ply", "b.ply"]
    assert files_of(tmp_path, [".ply"]) == seen_of(tmp_path.iterdir())
    hidden = tmp_path / ".thumbnails" / "c.ply"
    hidden.parent.mkdir()
    hidden.touch()
    assert hidden not in seen_of(tmp_path.rglob("*"), below=tmp_path)
    assert seen_of(hidden.parent.rglob("*"), below=hidden.parent) == [hidden]
    # Who names one means it.
    assert files_of(tmp_path / "._a.ply", [".ply"]) == [tmp_path / "._a.ply"]


@pytest.mark.parametrize("number", [errno.EMFILE, errno.EIO, errno.ENOSPC])
def test_a_glance_that_the_machine_denies_is_no_empty_file(tmp_path, monkeypatch, number):
    file = tmp_path / "a.xml"
    file.write_bytes(b"<chunk")
    assert beginning_of(file) == b"<chunk"

    def denied(*_, **__):
        raise OSError(number, os.strerror(number), str(file))

    monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(EnvironmentFailure, match=re.escape(str(file))):
        beginning_of(file)


def test_a_glance_that_a_file_denies_sees_nothing(tmp_path, monkeypatch):
    def denied(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    (tmp_path / "a.xml").write_bytes(b"<chunk")
    monkeypatch.setattr(Path, "open", denied)
    assert beginning_of(tmp_path / "a.xml") == b""
