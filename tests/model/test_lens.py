"""Lenses against pycolmap's cameras, which know nothing of ours."""

from __future__ import annotations

import numpy as np
import pytest

from usdbrdf.errors import InputRefused
from usdbrdf.model.lens import PINHOLE, Lens, whole_sphere

pycolmap = pytest.importorskip("pycolmap")
FOCAL = (500.0, 480.0, 322.0, 236.0)
ONE_FOCAL = (500.0, 500.0, 322.0, 236.0)
K = (-0.11, 0.023, -0.006, 0.0015, 0.012, -0.004)
# Model -> what follows focal lengths and principal point as COLMAP orders it, and our lens.
LENSES = {
    "SIMPLE_PINHOLE": ((), PINHOLE),
    "PINHOLE": ((), PINHOLE),
    "SIMPLE_RADIAL": (K[:1], Lens(radial=K[:1])),
    "RADIAL": (K[:2], Lens(radial=K[:2])),
    "OPENCV": ((*K[:2], 0.003, -0.002), Lens(radial=K[:2], tangential=(0.003, -0.002))),
    "FULL_OPENCV": (
        (*K[:2], 0.003, -0.002, *K[2:]),
        Lens(radial=K[:3], divisor=K[3:], tangential=(0.003, -0.002)),
    ),
    "OPENCV_FISHEYE": (K[:4], Lens(curve="fisheye", radial=K[:4])),
    "SIMPLE_RADIAL_FISHEYE": (K[:1], Lens(curve="fisheye", radial=K[:1])),
    "RADIAL_FISHEYE": (K[:2], Lens(curve="fisheye", radial=K[:2])),
    "SIMPLE_FISHEYE": ((), Lens(curve="fisheye")),
    "FISHEYE": ((), Lens(curve="fisheye")),
    "THIN_PRISM_FISHEYE": (
        (*K[:2], 0.003, -0.002, *K[2:4], 0.004, -0.001),
        Lens(
            curve="fisheye",
            radial=K[:4],
            tangential=(0.003, -0.002),
            prism=(0.004, 0.0, -0.001, 0.0),
        ),
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        (*K, 0.003, -0.002, 0.004, -0.001, 0.002, 0.0005),
        Lens(
            curve="fisheye",
            radial=K,
            tangential=(-0.002, 0.003),
            prism=(0.004, -0.001, 0.002, 0.0005),
            radial_first=True,
        ),
    ),
    "FOV": ((0.9,), Lens(curve="fov", shape=(0.9,))),
    "SIMPLE_DIVISION": ((-0.12,), Lens(curve="division", shape=(-0.12,))),
    "DIVISION": ((-0.12,), Lens(curve="division", shape=(-0.12,))),
    "EUCM": ((0.6, 1.1), Lens(curve="eucm", shape=(0.6, 1.1))),
    "EQUIRECTANGULAR": ((), Lens(curve="equirectangular")),
}


def test_every_model_of_colmap_is_here():
    assert set(pycolmap.CameraModelId.__members__) - {"INVALID"} == set(LENSES)


@pytest.mark.parametrize("model", LENSES)
def test_pixels_are_those_of_pycolmap(model):
    more, lens = LENSES[model]
    intrinsics, parameters = FOCAL, (*FOCAL, *more)
    if model == "EQUIRECTANGULAR":
        intrinsics, parameters = whole_sphere(640, 480), (640, 480)
    elif model.startswith("SIMPLE") or model in ("RADIAL", "RADIAL_FISHEYE"):
        intrinsics, parameters = ONE_FOCAL, (*ONE_FOCAL[1:], *more)
    camera = pycolmap.Camera(model=model, width=640, height=480, params=list(parameters))
    directions = np.random.default_rng(0).normal(size=(20_000, 3))
    # Directions near the axis, too, where angles are small; and the axis itself.
    directions[:5000, :2] *= 1e-3
    directions[0] = 0, 0, 2
    theirs = camera.img_from_cam(directions)
    ours = lens.project(directions * (1, -1, -1), intrinsics)
    # What lies in the picture or around it; COLMAP images nothing that lies behind a camera.
    near = (np.abs(theirs - (320, 240)) < (640, 480)).all(axis=1)
    if model != "EQUIRECTANGULAR":
        near &= directions[:, 2] > 1e-3
    before = np.arctan2(np.hypot(*directions.T[:2]), directions[:, 2]) < lens.widest_angle
    assert (near & before).sum() > 3000
    np.testing.assert_allclose(ours[near & before], theirs[near & before], atol=1e-9)
    assert np.isnan(ours[~before]).all()


def test_a_polynomial_that_turns_back_images_nothing_twice():
    """x (1 - k x^2) is largest at x = 1 / sqrt(3 k)."""
    lens = Lens(radial=(-0.3,))
    assert lens.widest_angle == pytest.approx(np.arctan(1 / np.sqrt(0.9)), abs=2e-4)
    angle = np.linspace(0.01, 1.5, 200)
    directions = np.stack([np.sin(angle), np.zeros(200), -np.cos(angle)], axis=-1)
    pixels = lens.project(directions, FOCAL)[:, 0]
    seen = np.isfinite(pixels)
    assert seen.sum() == (angle <= lens.widest_angle).sum()
    assert (np.diff(pixels[seen]) > 0).all()


def test_the_poles_of_a_sphere_and_what_lies_behind():
    lens, intrinsics = Lens(curve="equirectangular"), whole_sphere(200, 100)
    directions = np.array([[0.0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    pixels = lens.project(directions, intrinsics)
    np.testing.assert_allclose(pixels[:3], [[100, 50], [150, 50], [50, 50]])
    np.testing.assert_allclose(pixels[3:, 1], [0, 100])


@pytest.mark.parametrize(
    "made",
    [
        {"curve": "fish"},
        {"curve": "fov"},
        {"shape": (1.0,)},
        {"radial": (float("nan"),)},
        {"skew": float("inf")},
        {"radial": (0.1,) * 9},
    ],
)
def test_what_is_no_lens(made):
    with pytest.raises(InputRefused, match=r"no lens.*\[camera\.lens\]"):
        Lens(**made)


def test_what_bends_light():
    assert not PINHOLE.bends
    assert not Lens(radial=(0.0, 0.0)).bends
    assert not Lens(curve="division", shape=(0.0,)).bends
    assert Lens(curve="fisheye").bends
    assert Lens(skew=0.1).bends
