"""Arrays that a task leaves for its next run, where others have written some."""

import hashlib

import numpy as np
import pytest

from usdbrdf.files.documents import save_arrays
from usdbrdf.job import cache


@pytest.mark.fault("R7")
@pytest.mark.parametrize("record", [b"5", b"[1]", b"null", b"{", b""])
def test_a_record_of_another_kind_is_as_good_as_none(tmp_path, record):
    """Whoever alters the file can give it the name that its bytes ask for."""
    cache.keep(tmp_path, "atlas", {"made_for": "x"}, {"uv": np.arange(3)})
    assert cache.kept(tmp_path, "atlas")[0] == {"made_for": "x"}
    (file,) = (tmp_path / ".usdbrdf/cache").iterdir()
    save_arrays(file, {"uv": np.arange(3), "record": np.frombuffer(record, np.uint8)})
    file.rename(file.with_name(f"atlas.{hashlib.sha256(file.read_bytes()).hexdigest()}.npz"))
    assert cache.kept(tmp_path, "atlas") is None
