"""A room told otherwise is the same room: its objects in another order, its faces cut finer, its
photographs shuffled, all of it turned and somewhere else."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.dim_room import converted, means_of_objects, write_objects
from tests.scenes import MadeCapture, write_ply
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.readers.scene import read_fit, read_shading
from usdbrdf.job.progress import set_quiet


def _told_otherwise(made: MadeCapture) -> None:
    """The capture in place of itself; the world turned about its up axis and moved."""
    angle, rng = 0.7, np.random.default_rng(1)
    moved = np.eye(4)
    moved[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    moved[:3, 3] = 31.0, -12.0, 5.0
    points = (made.points @ moved[:3, :3].T + moved[:3, 3]).astype(np.float32)
    number = rng.permutation(len(made.names))
    faces = rng.permutation(len(made.triangles))
    write_ply(
        made.folder / "mesh.ply", points, made.triangles[faces], number[made.face_object[faces]]
    )
    write_objects(made, number)
    document = json.loads(made.manifest.read_text())
    for frame in document["frames"]:
        frame["transform_matrix"] = (moved @ np.array(frame["transform_matrix"])).tolist()
    order = rng.permutation(len(document["frames"]))
    document["frames"] = [document["frames"][i] for i in order]
    made.manifest.write_text(json.dumps(document))


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    set_quiet(True)
    try:
        return tuple(
            converted(tmp_path_factory.mktemp("room"), subdivisions, otherwise)
            for subdivisions, otherwise in ((2, None), (3, _told_otherwise))
        )
    finally:
        set_quiet(False)


def test_what_is_measured_of_objects_stays(both):
    relatives = {"lit": 1e-3, "irradiance": 0.04, "albedo": 0.06}
    usual, other = (means_of_objects(maps, [*relatives]) for maps in both)
    assert set(usual) == set(other)
    # Texels of a half of the box: its sides are measured in other places.
    for name in usual:
        for key, relative in relatives.items():
            np.testing.assert_allclose(
                other[name][key], usual[name][key], rtol=relative, err_msg=f"{name}: {key}"
            )


def test_what_shines_and_what_is_known_of_lobes_stays(both):
    def told(maps: AssetMaps) -> dict[str, object]:
        # No highlight tells psi here, and its bound is near the one below which it counts as such.
        alike = {"bounded": "undetermined"}
        fits = {obj: read_fit(maps.stage, obj.prim_path).status for obj in maps.scene.objects}
        return {
            obj.label: (
                read_shading(maps.stage, obj.prim_path).emitter,
                alike.get(fits[obj], fits[obj]),
            )
            for obj in maps.scene.objects
        }

    assert told(both[1]) == told(both[0])


@pytest.mark.parametrize("which", [0, 1])
def test_no_surface_sends_more_than_it_receives(both, which):
    maps = both[which]
    lit, irradiance, albedo = (maps.map(aov) for aov in ("lit", "irradiance", "albedo"))
    reflects = (maps.coverage.observed > 0) & (albedo.max(axis=1) > 0)
    assert reflects.mean() > 0.3
    assert albedo.min() >= 0
    assert albedo.max() <= 1
    sent, explained = np.pi * lit[reflects], (albedo * irradiance)[reflects]
    explains = np.abs(sent - explained) < 0.01 * sent + 1e-4
    # In corners that no ray lights well the albedo ends at 1.
    assert explains.mean() > 0.95
    assert (explained < 1.01 * sent + 1e-4).all()
