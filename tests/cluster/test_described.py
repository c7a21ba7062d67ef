"""What workers are given, as documents and files: what comes out is what went in, or nothing."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tests.scenes import room_mesh
from usdbrdf.cluster.described import described, restored
from usdbrdf.cluster.store import Folder, Store
from usdbrdf.errors import EnvironmentFailure, UsdBrdfError
from usdbrdf.model.scene import SceneObject
from usdbrdf.options import Sampling
from usdbrdf.transport.brdf import PAPER
from usdbrdf.transport.irradiance import whole_tiles
from usdbrdf.transport.rays import Hits, RayScene


def through(store: Store, value: object) -> object:
    document = json.loads(json.dumps(described(value, store), allow_nan=False))
    return restored(document, store, lambda _, make: make())


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(Folder(tmp_path / "shared"))


@pytest.mark.parametrize(
    "value",
    [
        None, True, 3, -1.5e-300, math.inf, "Nº 1\n", Path("/a b/c"), range(3, 9, 2),
        (1, [2.5, (None,)]), {PAPER: "x", "two": (1, 2)}, np.float32(0.1), np.int64(-7),
        Sampling(max_rays=64, seed=9), whole_tiles,
        SceneObject(prim_path="/a", identifier="a", label="", class_name="", first_face=0,
                    num_faces=2),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_values_come_back_of_the_same_type(store: Store, value: object) -> None:
    found = through(store, value)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize("shape", [(), (0, 3), (5,), (40, 30, 3)])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i4", "i8", "u1", "?"])
def test_arrays_come_back_bit_for_bit_and_can_be_written_to(
    store: Store, shape: tuple[int, ...], dtype: str
) -> None:
    values = np.frombuffer(np.random.default_rng(1).bytes(40 * 30 * 3 * 8), np.uint8)
    count = math.prod(shape)
    array = (values[:count] & 1 if dtype == "?" else values[:count]).astype(dtype).reshape(shape)
    for given in (array, np.asfortranarray(array), np.asarray(np.repeat(array[None], 2, 0)[1])):
        found = through(store, given)
        assert isinstance(found, np.ndarray)
        assert (found.dtype, found.shape) == (given.dtype, given.shape)
        assert found.tobytes() == given.tobytes()
        assert found.flags.writeable  # numba knows those that are not as another type
        assert type(found) is np.ndarray


def test_every_other_row_is_kept_as_an_array_of_its_own(store: Store) -> None:
    rows = np.arange(6000, dtype=np.float32).reshape(-1, 3)[::2]
    np.testing.assert_array_equal(through(store, rows), rows)


def test_equal_arrays_are_one_file(store: Store) -> None:
    array = np.arange(1000.0)
    assert store.keep(array) == store.keep(array.copy())
    assert len(list(store.files.folder.iterdir())) == 1


def test_a_scene_of_rays_is_built_again_and_meets_the_same(store: Store) -> None:
    points, triangles, *_ = room_mesh(room=True, subdivisions=4)
    scene = RayScene(points, triangles)
    found = through(store, scene)
    assert isinstance(found, RayScene)
    origins = np.repeat(points.mean(axis=0, dtype=np.float32)[None], 500, axis=0)
    directions = np.random.default_rng(2).standard_normal((500, 3)).astype(np.float32)
    ours, theirs = scene.closest(origins, directions), found.closest(origins, directions)
    for name in Hits._fields:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


def test_what_was_damaged_is_not_taken(store: Store) -> None:
    name = store.keep(np.arange(1000.0))
    file = store.files.folder / name
    content = bytearray(file.read_bytes())
    content[-1] ^= 1
    file.write_bytes(content)
    with pytest.raises(EnvironmentFailure, match=r"not what its name tells.*\[cluster.folder\]"):
        store.array(name)
    file.unlink()
    with pytest.raises(EnvironmentFailure, match="--shared-folder"):
        store.array(name)


def test_what_was_damaged_is_kept_anew(store: Store) -> None:
    array = np.arange(1000.0)
    file = store.files.folder / store.keep(array)
    file.write_bytes(file.read_bytes()[:-1])
    assert store.keep(array) == file.name
    np.testing.assert_array_equal(store.array(file.name), array)


@pytest.mark.parametrize("name", ["os:system", "usdbrdf.cli:main.x", "usdbrdfx.cli:main"])
def test_no_names_but_ours_are_followed(store: Store, name: str) -> None:
    with pytest.raises(UsdBrdfError, match=r"\[cluster.value\]"):
        restored({"made": name, "of": {}}, store, lambda _, make: make())
    with pytest.raises(UsdBrdfError, match=r"\[cluster.value\]"):
        restored({"name": name}, store, lambda _, make: make())


def test_what_is_not_ours_is_not_told(store: Store) -> None:
    for value in (print, Path, math, np.array([None])):
        with pytest.raises((UsdBrdfError, AttributeError)):
            described(value, store)
