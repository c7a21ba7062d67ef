"""Objects of a scan that has none, or whose own are not wanted: by its shape and its colours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from usdbrdf.capture.checks import spread_evenly
from usdbrdf.capture.parts import objects_with_faces
from usdbrdf.files.frames import Read, read_frames
from usdbrdf.geometry.segment_colours import colours_of_faces, divided_by_colour
from usdbrdf.geometry.segments import links_of_faces, segments_of_mesh
from usdbrdf.job.progress import progress, say
from usdbrdf.model.arrays import Bool, Float, Int
from usdbrdf.model.camera import Camera
from usdbrdf.model.capture import Frames
from usdbrdf.model.mesh import ObjectLabel, ObjectName, ScanMesh, doubled_areas
from usdbrdf.transport.rays import RayScene

# Frames that tell the colours, and numbers that each of them keeps.
_FRAMES, _MOST_NUMBERS = 32, 1 << 26


def segmented(
    mesh: ScanMesh, own: int, frames: Frames, read: Read
) -> tuple[ScanMesh, tuple[ObjectLabel, ...], dict[str, Any]]:
    """The mesh divided into objects, these, and how many of each kind, for the record.

    own   how many faces are the capture's own, behind which come second skins
    read  the frames' pixels
    """
    rays = RayScene(mesh.points, mesh.triangles)
    asked = frames_that_tell_colours(mesh, len(frames))

    def shown() -> Iterator[tuple[Camera, Float, Bool]]:
        images = read_frames(read, asked)
        for i, pixels in progress(images, total=len(asked), label="objects", unit="frames"):
            yield frames.camera(i), pixels.radiance, pixels.valid

    colours = colours_of_faces(rays, shown(), len(asked))
    triangles = mesh.triangles[:own]
    found = segments_of_mesh(mesh.points, triangles)
    divided = divided_by_colour(
        found.face,
        colours[:own],
        doubled_areas(mesh.points, triangles) / 2,
        links_of_faces(mesh.points, triangles),
        range(found.planes),
    )
    labels, number = _labels(found.face, divided, found.planes, found.parts)
    face_object, objects = objects_with_faces(
        _with_second_skins(mesh, number[divided]), tuple(map(ObjectName, labels))
    )
    told = {
        "planes": found.planes,
        "colours_on_planes": int(divided.max()) - int(found.face.max()),
        "parts": found.parts,
    }
    say(
        f"ingest: {len(objects)} objects segmented from shape and colour: {told['planes']} planes, "
        f"{told['colours_on_planes']} other colours on them, {told['parts']} parts"
    )
    return replace(mesh, face_object=face_object), objects, told


def frames_that_tell_colours(mesh: ScanMesh, count: int) -> list[int]:
    """Numbers of those of ``count`` frames that are asked, as many as the memory holds."""
    most = max(1, _MOST_NUMBERS // (3 * len(mesh.triangles)))
    return spread_evenly(count, min(_FRAMES, most))


def _labels(face: Int, divided: Int, planes: int, parts: int) -> tuple[list[str], Int]:
    """Names, and the name's number for each segment: a plane is followed by its other colours."""
    names: list[str] = []
    number = np.zeros(int(divided.max()) + 1, np.int32)
    for segment in range(int(face.max()) + 1):
        colours = np.unique(divided[face == segment]).tolist()
        for k, own in enumerate(sorted(colours)):
            number[own] = len(names)
            if segment < planes:
                names.append(f"plane_{segment + 1:03d}" + (f"_colour_{k + 1}" if k else ""))
            elif segment < planes + parts:
                names.append(f"part_{segment - planes + 1:03d}")
            else:
                names.append("rest")
    return names, number


def _with_second_skins(mesh: ScanMesh, face_object: Int) -> Int:
    """(F,) of all faces: a second skin lies closest to the face that it is the back of."""
    own = len(face_object)
    if own == len(mesh.triangles):
        return face_object
    centre = mesh.points.astype(np.float64)[mesh.triangles].mean(axis=1)
    nearest = cKDTree(centre[:own]).query(centre[own:])[1]
    return np.concatenate([face_object, face_object[nearest]])
