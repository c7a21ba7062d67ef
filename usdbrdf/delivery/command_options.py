"""The options of ``usdbrdf package`` and the values that they become."""

from __future__ import annotations

import argparse
from pathlib import Path

from usdbrdf.delivery.package import ARKIT, DEFAULT, PackageOptions
from usdbrdf.delivery.packaged_files import EXR, PNG


def add_package_options(parser: argparse.ArgumentParser) -> None:
    known = PackageOptions()
    add = parser.add_argument
    add("asset", type=Path, metavar="ASSET", help="asset folder; it is not changed")
    add(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="FILE",
        help=".usdz, or .glb (metres, y up) for what reads no USD; replaced if it is there",
    )
    add(
        "--textures",
        choices=(EXR, PNG),
        help="exr: as they are; png: 8 bits, colours in sRGB; default: exr, but png in .glb and "
        "with --profile arkit",
    )
    add("--max-size", type=int, metavar="PIXELS", help="reduce textures to this longer side")
    add("--look", metavar="NAME", help="the look that is packed; default: the one it opens in")
    add(
        "--profile",
        choices=(DEFAULT, ARKIT),
        default=known.profile,
        help="arkit: y up, PNG, no cameras and lights, for AR Quick Look",
    )


def package_options(chosen: argparse.Namespace) -> PackageOptions:
    return PackageOptions(
        textures=chosen.textures,
        max_size=chosen.max_size,
        look=chosen.look,
        profile=chosen.profile,
    )
