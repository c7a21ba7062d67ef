"""The options of the fit on the command line, and the frozen values that they become."""

from __future__ import annotations

import argparse

from usdbrdf.material.fit_objects import FitOptions


def add_fit_options(parser: argparse.ArgumentParser) -> None:
    known = FitOptions()
    add = parser.add_argument_group("fit").add_argument
    add(
        "--fit",
        dest="method",
        choices=("views", "scaled", "paper"),
        default=known.method,
        help="views: many views per texel, L_d free; scaled: one target frame, L_d times a free "
        "factor; paper: one target frame, the paper's residual",
    )
    add(
        "--max-pixels",
        type=int,
        default=known.max_pixels,
        metavar="N",
        help="fit to at most this many pixels of an object's target frame",
    )
    add(
        "--material",
        dest="mapping",
        choices=("measured", "matched"),
        default=known.mapping,
        help="what UsdPreviewSurface is told: measured: roughness and specular as fitted; matched: "
        "as renderers need them to show that",
    )
    add(
        "--materialx",
        action="store_true",
        help="write OpenPBR networks of MaterialX too, as layers/materialx.usda",
    )


def fit_options(chosen: argparse.Namespace) -> FitOptions:
    return FitOptions(
        method=chosen.method,
        max_pixels=chosen.max_pixels,
        mapping=chosen.mapping,
        materialx=chosen.materialx,
        environment=chosen.environment,
        memory=chosen.memory,
        seed=chosen.seed,
    )
