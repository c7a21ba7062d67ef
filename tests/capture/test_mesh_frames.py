"""Places on a mesh, at which points that lie on it are looked for."""

from __future__ import annotations

import numpy as np

from usdbrdf.capture import mesh_frames


def test_places_are_everywhere_and_not_all_corners(monkeypatch):
    """A thing of many small faces before a wall of two, which take their share of the places."""
    monkeypatch.setattr(mesh_frames, "_MOST_FACES", 100)
    side = 40
    across, up = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side))
    thing = np.stack([across.ravel(), up.ravel(), np.zeros(side**2)], axis=1)
    wall = np.array([[0.0, 0, -1], [3, 0, -1], [3, 3, -1], [0, 3, -1]])
    k = np.arange(side**2).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    quads = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    of_wall = np.array([[0, 1, 2], [0, 2, 3]]) + side**2
    points = np.concatenate([thing, wall]).astype(np.float32)
    places = mesh_frames._places_on(points, np.concatenate([quads, of_wall]).astype(np.int32))
    assert len(places) < mesh_frames._PLACES + 3 * 100
    # Nine tenths of the area.
    assert abs((places[:, 2] < -0.5).mean() - 0.9) < 0.01
    on_wall = places[places[:, 2] < -0.5]
    counts, _, _ = np.histogram2d(on_wall[:, 0], on_wall[:, 1], bins=3, range=[[0, 3], [0, 3]])
    assert counts.min() > 0.9 * counts.mean()
