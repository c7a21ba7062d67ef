"""What is said where few rays of the cameras hit the mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from usdbrdf.capture import camera_checks
from usdbrdf.errors import InputRefused

PROBE = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])


def _shares(monkeypatch, *, own, others, framed):
    def hit(scene, frames, read):
        return own if np.array_equal(read(PROBE), PROBE) else others

    monkeypatch.setattr(camera_checks, "_hit_share", hit)
    monkeypatch.setattr(camera_checks, "_framed_share", lambda scene, frames: framed)


def test_of_a_mesh_of_a_part_no_other_reading_of_the_poses_is_named(monkeypatch):
    """Of a figure in a room, seen closely: any rays hit a little more or less of it."""
    _shares(monkeypatch, own=0.18, others=0.21, framed=0.5)
    with pytest.raises(InputRefused, match=r"18% of .* None of 17 usual conventions does"):
        camera_checks.refuse_rays_that_miss(None, None, Path("room"))
    _shares(monkeypatch, own=0.18, others=0.21, framed=0.9)
    assert camera_checks.refuse_rays_that_miss(None, None, Path("room")) == 0.18


def test_readings_that_hit_clearly_more_are_named(monkeypatch):
    _shares(monkeypatch, own=0.12, others=0.5, framed=0.9)
    with pytest.raises(InputRefused, match=r"Other readings of the poses would hit: .*50%"):
        camera_checks.refuse_rays_that_miss(None, None, Path("room"))
