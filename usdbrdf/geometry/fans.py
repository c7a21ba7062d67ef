"""Points of a mesh whose faces do not hang together around them, one for each fan of faces."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from usdbrdf.model.arrays import Int
from usdbrdf.model.mesh import edges_of_two


def point_of_each_fan(triangles: Int) -> tuple[Int, Int]:
    """Which point (P,) each new one is a copy of, and triangles (F, 3) of the new ones.

    Faces hang together across an edge that two of them share, running along it in opposite
    directions. Applications that keep a mesh by its points, as Blender does, have one normal for
    the corners there, which of several fans is that of any: of a wall, that of the floor.
    """
    start = triangles.reshape(-1)
    corner = np.arange(len(start), dtype=np.int32).reshape(-1, 3)
    following = np.roll(corner, -1, axis=1).reshape(-1)
    one, other = edges_of_two(triangles)
    opposite = start[one] == start[following[other]]
    one, other = one[opposite], other[opposite]
    # The corner where an edge starts is that where the other face's edge ends.
    here = np.concatenate([one, following[one]])
    there = np.concatenate([following[other], other])
    links = coo_array((np.ones(len(here), np.bool_), (here, there)), shape=(len(start), len(start)))
    fan = connected_components(links, directed=False)[1]
    # In the order of the points, so that a mesh that is sound stays as it was.
    _, leader = np.unique(fan, return_index=True)
    order = np.argsort(start[leader], kind="stable")
    number = np.empty(len(order), np.int32)
    number[order] = np.arange(len(order), dtype=np.int32)
    return start[leader][order].astype(np.int32), number[fan].reshape(-1, 3)
