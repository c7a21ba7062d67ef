"""What was written is held against what was meant, hole for hole."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.files.images import refuse_other, write_exr


@pytest.mark.parametrize("where", ["meant", "stored"])
def test_a_hole_on_one_side_alone_is_another_picture(tmp_path, where):
    whole = np.arange(1, 49, dtype=np.float32).reshape(4, 4, 3)
    holed = whole.copy()
    holed[1, 2] = np.nan
    meant, stored = (holed, whole) if where == "meant" else (whole, holed)
    write_exr(tmp_path / "a.exr", stored, half=False, holes=True)
    refuse_other(tmp_path / "a.exr", tmp_path / "a.exr", stored, holes=True)
    with pytest.raises(EnvironmentFailure, match=r"does not read back.+\[image\.write\]$"):
        refuse_other(tmp_path / "a.exr", tmp_path / "a.exr", meant, holes=True)
