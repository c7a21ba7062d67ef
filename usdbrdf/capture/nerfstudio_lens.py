"""The lens of a frame of transforms.json: nerfstudio's and instant-ngp's keys for it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from usdbrdf.errors import InputRefused
from usdbrdf.model.lens import Curve, Lens

_CURVES: dict[str, Curve] = {
    "PINHOLE": "perspective", "SIMPLE_PINHOLE": "perspective", "OPENCV": "perspective",
    "PERSPECTIVE": "perspective", "SIMPLE_RADIAL": "perspective", "RADIAL": "perspective",
    "FULL_OPENCV": "perspective", "FISHEYE": "fisheye", "OPENCV_FISHEYE": "fisheye",
    "FISHEYE624": "fisheye", "EQUIRECTANGULAR": "equirectangular",
}  # fmt: skip
_DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "s1", "s2", "s3", "s4")
# What no kept program writes, and whose meaning differs between those that have such terms.
_UNREAD = ("sk_y", "b1", "b2", "p3", "p4", "k7", "k8", "tau_x", "tau_y")
# In pixels: by so many columns a point moves that lies a focal length below the axis.
_SKEW = ("sk_x", "skew", "skew_x")
# Lenses that instant-ngp has by a key: the longitudes and latitudes of a whole sphere, their
# equal-area cylinder, none, and a polynomial of the pixels' distance.
_NGP_LENSES = ("latlong", "equirectangular", "orthographic", "ftheta_p0")


def lens_of_frame(
    said: Mapping[str, Any],
    number: Callable[[str], float | None],
    refuse: Callable[[str], InputRefused],
) -> Lens:
    """What camera_model, or instant-ngp's is_fisheye, and the distortion of a frame, else of the
    document, say; but for ``with_skew``.

    k1 to k4 are coefficients of r^2 to r^8, as nerfstudio has them; where k5 or k6 stand beside
    them, k4 to k6 are OpenCV's, which divide.

    said    all keys of the document and of the frame, which come first
    number  the number that one of them is
    refuse  what is raised, by what is wrong with the frame
    """
    usual = _lens_key(said) or ("OPENCV_FISHEYE" if said.get("is_fisheye") is True else "PINHOLE")
    stated = said.get("camera_model")
    model = usual if stated is None else stated.upper() if isinstance(stated, str) else stated
    if not isinstance(model, str) or model not in _CURVES:
        raise refuse(
            f"has the camera model {(usual if stated is None else stated)!r} "
            f"(known: {', '.join(_CURVES)}). Undistort the images to a pinhole camera first."
        )
    curve = _CURVES[model]
    if curve == "equirectangular":
        return Lens(curve=curve)
    if unread := next((key for key in _UNREAD if number(key)), None):
        raise refuse(
            f"has {unread} {number(unread):g}, a term of its lens that is not read. Undistort the "
            "images to a pinhole camera first, or remove it."
        )
    circle = _circle(number, refuse) if curve == "fisheye" else math.inf
    if (listed := said.get("distortion_params")) is not None:
        return _listed_lens(curve, listed, circle, refuse)
    terms = {key: number(key) for key in _DISTORTION}
    k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4 = (value or 0.0 for value in terms.values())
    divides = terms["k5"] is not None or terms["k6"] is not None
    return Lens(
        curve=curve,
        radial=(k1, k2, k3) if divides else (k1, k2, k3, k4),
        divisor=(k4, k5, k6) if divides else (),
        tangential=(p1, p2),
        prism=(s1, s2, s3, s4),
        circle=circle,
    )


def with_skew(lens: Lens, number: Callable[[str], float | None], focal: float) -> Lens:
    """The lens with the skew that is stated in pixels, of which ``focal`` is the length fx."""
    stated = next((value for key in _SKEW if (value := number(key))), 0.0)
    return replace(lens, skew=stated / focal) if lens.curve != "equirectangular" else lens


def focal_of_angle(
    positive: Callable[[str], float | None],
    refuse: Callable[[str], InputRefused],
    axis: str,
    size: float,
) -> float | None:
    """The focal length in pixels of an image that is as wide as an angle, of the two that documents
    have for it, the second instant-ngp's; None without either."""
    for key, half_turn, unit in (
        (f"camera_angle_{axis}", math.pi, "radians"),
        (f"{axis}_fov", 180.0, "degrees"),
    ):
        angle = positive(key)
        if angle is not None and angle >= half_turn:
            # Its tangent may be that of another angle altogether.
            raise refuse(
                f"{key} is {angle:g}, but it is in {unit}, below {half_turn:.4g}. Correct it, or "
                "state the focal length in pixels."
            )
        if angle is not None:
            return size / (2 * math.tan(angle / half_turn * math.pi / 2))
    return None


def _lens_key(said: Mapping[str, Any]) -> str:
    """The camera_model that is meant by one of instant-ngp's keys for its lenses (read_lens); the
    key itself where no model that is known is; "" where there is none. 0 is a coefficient too."""
    key = next((k for k in _NGP_LENSES if said.get(k) is not None and said[k] is not False), "")
    return "EQUIRECTANGULAR" if key == "latlong" else key


def _circle(number: Callable[[str], float | None], refuse: Callable[[str], InputRefused]) -> float:
    """What nerfstudio's fisheye_crop_radius, in pixels, says of how far the picture reaches."""
    radius, focal = number("fisheye_crop_radius"), number("fl_x")
    if radius is None or focal is None:
        return math.inf
    if not (radius > 0 and focal > 0):
        raise refuse(f"has a fisheye_crop_radius of {radius:g}. Correct or remove it.")
    return radius / focal


def _listed_lens(
    curve: Curve, listed: object, circle: float, refuse: Callable[[str], InputRefused]
) -> Lens:
    """nerfstudio's distortion_params: k1 to k4, p1, p2; or the twelve of Aria's FISHEYE624."""
    sound = isinstance(listed, list) and all(type(n) in (int, float) for n in listed)
    if not (sound and isinstance(listed, list) and len(listed) in (6, 12)):
        raise refuse("has distortion_params that are not 6 or 12 numbers. Correct them.")
    numbers = [float(n) for n in listed]
    if len(numbers) == 6:
        k1, k2, k3, k4, p1, p2 = numbers
        return Lens(curve=curve, radial=(k1, k2, k3, k4), tangential=(p1, p2), circle=circle)
    p0, p1, s0, s1, s2, s3 = numbers[6:]
    return Lens(
        curve=curve,
        radial=tuple(numbers[:6]),
        tangential=(p1, p0),
        prism=(s0, s1, s2, s3),
        radial_first=True,
        circle=circle,
    )
