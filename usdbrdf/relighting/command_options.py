"""The options of ``usdbrdf relight`` and the values that they become."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from usdbrdf.errors import InputRefused, UsageError
from usdbrdf.options import finite_number, seed_number
from usdbrdf.relighting.insert import Insert
from usdbrdf.relighting.relight import MIN_BOUNCES, RelightOptions
from usdbrdf.transport.denoise import CHOICES

_INSERT_HELP = """put a model in (USD, OBJ, PLY, GLB); may be given again. at=X,Y,Z, or
drop=X,Y[,Z]: let it fall there (from the height Z; default: from that of the highest capture
camera), or matrix=FILE with 4 x 4 numbers; scale=S, rotate=DEG about the up axis, up=Y|Z of an OBJ
or PLY; color=R,G,B, roughness=R, ior=N, metallic=M instead of the model's. Lengths in units of the
stage"""


def add_relight_options(parser: argparse.ArgumentParser) -> None:
    known = RelightOptions()
    add = parser.add_argument
    add("asset", type=Path, metavar="ASSET", help="asset folder; it is not changed")
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="IMAGE",
        help=".exr: linear float radiance; .png, .jpg: exposed, sRGB; with --views a folder",
    )
    add(
        "--lights",
        default="capture",
        metavar="FILE",
        help="capture: the recovered emitters; or a USD file with lights or glowing meshes, or a "
        "latitude-longitude .exr or .hdr, in their place",
    )
    add("--keep-emitters", action="store_true", help="leave the captured light on beside --lights")
    add(
        "--insert",
        nargs="+",
        action="append",
        default=[],
        metavar=("MODEL", "KEY=VALUE"),
        help=_INSERT_HELP,
    )
    add("--camera", metavar="PRIM", help="path of a camera in the stage; default: the capture's")
    add("--frame", type=finite_number, metavar="N", help="time code; default: the first")
    add("--views", type=Path, metavar="FILE", help="nerfstudio document with poses to render from")
    add("--format", choices=("exr", "png", "jpg"), default=known.format, help="with --views")
    add("--width", type=int, metavar="N", help="pixels across; default: the camera's")
    add("--samples", type=int, default=known.samples, metavar="N", help="paths per pixel")
    add(
        "--bounces",
        type=int,
        default=known.bounces,
        metavar="N",
        help=f"reflections along a path, at least {MIN_BOUNCES}",
    )
    add(
        "--seed",
        type=seed_number,
        default=known.seed,
        metavar="N",
        help="seed of the random numbers",
    )
    add(
        "--denoise",
        choices=CHOICES,
        default=known.denoise,
        help="filter the picture; oidn needs usdbrdf[denoise], auto takes it where it is there",
    )
    add(
        "--exposure",
        type=finite_number,
        metavar="STOPS",
        help="of .png and .jpg; default: the 90th percentile of mean RGB becomes 0.8",
    )


def relight_options(chosen: argparse.Namespace) -> RelightOptions:
    return RelightOptions(
        lights=None if chosen.lights == "capture" else Path(chosen.lights),
        keep_emitters=chosen.keep_emitters,
        inserts=tuple(_insert(words) for words in chosen.insert),
        camera=chosen.camera,
        frame=chosen.frame,
        views=chosen.views,
        samples=chosen.samples,
        bounces=chosen.bounces,
        width=chosen.width,
        seed=chosen.seed,
        denoise=chosen.denoise,
        exposure=chosen.exposure,
        format=chosen.format,
    )


def _insert(words: list[str]) -> Insert:
    """MODEL KEY=VALUE ..., as typed."""
    model, *settings = words
    known: dict[str, Any] = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        if not equals or key not in _KEYS:
            raise UsageError(
                f"--insert {model}: {setting!r} is none of {', '.join(f'{k}=' for k in _KEYS)}. "
                "[relight.insert]"
            )
        name, read = _KEYS[key]
        known[name] = read(value, f"--insert {model}: {setting}")
    if sum(name in known for name in ("at", "drop", "matrix")) > 1:
        raise UsageError(
            f"--insert {model}: at=, drop= and matrix= exclude each other. [relight.insert]"
        )
    return Insert(model=Path(model), **known)


def _numbers(*counts: int, low: float = -math.inf, high: float = math.inf) -> Callable[..., Any]:
    """A reader of so many numbers with commas between them, each finite and in [low, high]."""

    def read(text: str, said: str) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in text.split(","))
        except ValueError:
            values = ()
        usable = all(math.isfinite(v) and low <= v <= high for v in values)
        if len(values) not in counts or not usable:
            shape = " or ".join(str(count) for count in counts)
            limits = "" if math.isinf(low) else f" of at least {low:g}"
            limits += "" if math.isinf(high) else f" and at most {high:g}"
            raise UsageError(f"{said}: expected {shape} finite number(s){limits}. [relight.insert]")
        return values

    return read


def _number(low: float = -math.inf, high: float = math.inf) -> Callable[..., Any]:
    read = _numbers(1, low=low, high=high)
    return lambda text, said: read(text, said)[0]


def _up(text: str, said: str) -> str:
    if text.upper() not in ("Y", "Z"):
        raise UsageError(f"{said}: expected Y or Z. [relight.insert]")
    return text.upper()


def _matrix(text: str, said: str) -> Any:
    path = Path(text)
    if not path.is_file():
        raise InputRefused(f"{path}: no such file. Check the path. [usage.file]")
    try:
        matrix = np.loadtxt(path).reshape(4, 4)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputRefused(
            f"{path}: expected 4 rows of 4 numbers, world from model. Correct it. [relight.matrix]"
        ) from error
    singular = abs(np.linalg.det(matrix[:3, :3])) < 1e-12
    if not np.isfinite(matrix).all() or singular or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        raise InputRefused(
            f"{path}: no invertible affine matrix; its last row must be 0 0 0 1. Correct it. "
            "[relight.matrix]"
        )
    return matrix


_KEYS: dict[str, tuple[str, Callable[..., Any]]] = {
    "at": ("at", _numbers(3)),
    "drop": ("drop", _numbers(2, 3)),
    "matrix": ("matrix", _matrix),
    "scale": ("scale", _number(1e-9)),
    "rotate": ("rotate_deg", _number()),
    "up": ("up", _up),
    "roughness": ("roughness", _number(0, 1)),
    "ior": ("ior", _number(1)),
    "metallic": ("metallic", _number(0, 1)),
    "color": ("color", _numbers(3, low=0)),
}
