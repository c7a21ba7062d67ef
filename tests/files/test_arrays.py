"""Arrays keep their bits; pickles do not come in."""

from __future__ import annotations

import errno
import os
import zipfile

import numpy as np
import pytest

from usdbrdf.errors import EnvironmentFailure, InputRefused
from usdbrdf.files.documents import load_arrays, save_arrays
from usdbrdf.files.tables import read_array


def test_equal_arrays_give_equal_bytes(tmp_path):
    for name in ("a.npz", "b.npz"):
        save_arrays(tmp_path / name, {"x": np.arange(5), "y/z": np.array([np.nan])})
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    assert list(load_arrays(tmp_path / "a.npz")) == ["x", "y/z"]


@pytest.mark.fault("S7")
def test_pickles_and_damage_are_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, x=np.array([{}], dtype=object))
    with pytest.raises(InputRefused, match=r"pickled data is refused.+\[arrays\.damaged\]$"):
        load_arrays(path)
    np.save(tmp_path / "pickle.npy", np.array([{}], dtype=object))
    with pytest.raises(InputRefused):
        load_arrays(tmp_path / "pickle.npy")
    save_arrays(path, {"x": np.arange(500)})
    whole = path.read_bytes()
    for content in (b"", whole[:100], whole[:-1], whole[:2000] + b"?" + whole[2001:]):
        path.write_bytes(content)
        with pytest.raises(InputRefused):
            load_arrays(path)
    with pytest.raises(InputRefused):
        load_arrays(tmp_path / "none.npz")


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
def test_arrays_are_read_in_any_of_numpy_s_formats(tmp_path, version):
    """Headers of the second have a length of four bytes, those of the third may hold any name."""
    kind = np.float32 if version < (3, 0) else np.dtype([("höhe", np.float32)])
    values = np.arange(12, dtype=np.float32).view(kind).reshape(3, 4)
    with (tmp_path / "x.npy").open("wb") as file:
        np.lib.format.write_array(file, values, version)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "x.npy", "x.npy")
    np.testing.assert_array_equal(load_arrays(tmp_path / "a.npz")["x"], values)


@pytest.mark.fault("S7")
@pytest.mark.parametrize(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999, 17), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (99999999999999999999999, ), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (5, ",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-5, ), }",
        "({" * 60,
    ],
    ids=["more than it holds", "no whole number", "cut short", "less than nothing", "nested"],
)
def test_a_header_that_lies_is_refused_in_one_line(tmp_path, header):
    text = header.encode().ljust(127) + b"\n"
    content = b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + bytes(40)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", content)
    (tmp_path / "a.npy").write_bytes(content)
    for read, name in ((load_arrays, "a.npz"), (read_array, "a.npy")):
        with pytest.raises(InputRefused) as refused:
            read(tmp_path / name)
        assert "\n" not in str(refused.value)
        assert str(refused.value).endswith("[arrays.damaged]")


def test_what_the_machine_lacks_is_no_damage(tmp_path, monkeypatch):
    """A thread, an open file, a disk that answers: not to be made again by exporting anything."""
    path = tmp_path / "a.npz"
    save_arrays(path, {"x": np.arange(500)})
    np.save(tmp_path / "a.npy", np.arange(5))
    for error, rule in (
        (RuntimeError("can't start new thread"), "environment.processes"),
        (OSError(errno.EMFILE, "Too many open files"), "environment.io"),
        (OSError(errno.EIO, "Input/output error"), "environment.io"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "environment.memory"),
    ):

        def failing(*_, error=error, **__):
            raise error

        with monkeypatch.context() as patched:
            patched.setattr(np.lib.format, "read_magic", failing)
            patched.setattr(np, "load", failing)
            for read in (lambda: load_arrays(path), lambda: read_array(tmp_path / "a.npy")):
                with pytest.raises(EnvironmentFailure, match=rf"\[{rule}\]$"):
                    read()
    assert load_arrays(path)["x"][7] == 7


def test_a_disk_that_fails_is_no_damaged_file(tmp_path, monkeypatch):
    """zipfile answers a read that fails with "not a zip file"."""
    save_arrays(tmp_path / "a.npz", {"x": np.arange(3)})

    def failing(file):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(zipfile, "_EndRecData", failing)
    with pytest.raises(EnvironmentFailure, match=r"Input/output error.+\[environment\.io\]$"):
        load_arrays(tmp_path / "a.npz")
