"""Documents that an editor has saved with a byte order mark, or in UTF-16, are what they were."""

from __future__ import annotations

import numpy as np
import pytest

from tests.fuzzing import seeds
from usdbrdf.capture.adapters import read_scan
from usdbrdf.options import IngestOptions

OPTIONS = IngestOptions(assume_srgb=True)
DOCUMENTS = {
    "bundler": ("", "bundler", "bundle.out"),
    "visualsfm": ("", "visualsfm", "room.nvm"),
    "pix4d": ("", "pix4d", "room_calibrated_camera_parameters.txt"),
    "rgbd_scan log": ("log", "rgbd-scan", "trajectory.log"),
    "rgbd_scan record3d": ("record3d", "rgbd-scan", "metadata"),
}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_a_mark_hides_no_document(tmp_path, name):
    place, adapter, document = DOCUMENTS[name]
    getattr(seeds, name.split()[0])(tmp_path)
    folder = tmp_path / place
    before = read_scan(folder, OPTIONS)
    assert before.adapter == adapter
    (file,) = folder.rglob(document)
    text = file.read_text()
    for encoding in ("utf-8-sig", "utf-16"):
        file.write_text(text, encoding=encoding)
        after = read_scan(folder, OPTIONS)
        np.testing.assert_array_equal(
            after.frames.world_from_camera, before.frames.world_from_camera
        )
        assert after.adapter == adapter
