"""Arrays keep their bits; pickles do not come in."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.files.documents import load_arrays, save_arrays


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
