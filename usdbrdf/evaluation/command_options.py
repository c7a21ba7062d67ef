"""What can be said to ``evaluate`` and ``compare``."""

from __future__ import annotations

import argparse
from pathlib import Path

from usdbrdf.evaluation.evaluate_views import EvaluateOptions
from usdbrdf.options import existing_file


def add_evaluate_options(parser: argparse.ArgumentParser) -> None:
    """The asset, the views, how they are rendered, the truth."""
    known = EvaluateOptions()
    add = parser.add_argument
    add("asset", type=Path, metavar="ASSET", help="asset folder; it is not changed")
    _add_results_option(parser, "evaluation")
    add(
        "--views",
        type=existing_file,
        required=True,
        metavar="FILE",
        help="nerfstudio document (transforms.json) of views of the capture, held out or its own",
    )
    add(
        "--samples-per-pixel",
        type=int,
        default=known.samples_per_pixel,
        metavar="N",
        help="points that a rendered pixel is the mean of; a square number",
    )
    add(
        "--rays",
        type=int,
        default=known.rays,
        metavar="N",
        help="rays per pixel for the specular light, shared among its points",
    )
    add(
        "--truth",
        type=Path,
        metavar="FOLDER",
        help="compare with known materials: objects.json and albedo_vertex.npz; default: none",
    )
    add(
        "--mesh",
        type=existing_file,
        metavar="FILE",
        help="mesh whose vertices the known albedo belongs to; default: mesh.ply beside --truth",
    )
    add(
        "--allow-outside",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="let the document name files in this folder too; may be given again; default: none",
    )


def add_compare_options(parser: argparse.ArgumentParser) -> None:
    """Two assets, and where to write."""
    for name in ("first", "second"):
        parser.add_argument(name, type=Path, metavar="ASSET", help="asset folder; not changed")
    _add_results_option(parser, "comparison")


def evaluate_options(chosen: argparse.Namespace) -> EvaluateOptions:
    return EvaluateOptions(
        samples_per_pixel=chosen.samples_per_pixel,
        rays=chosen.rays,
        environment=chosen.environment,
        seed=chosen.seed,
        truth=chosen.truth,
        mesh=chosen.mesh,
        allow_outside=tuple(chosen.allow_outside),
    )


def _add_results_option(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path(default),
        metavar="FOLDER",
        help="folder for figures and pictures, made if it is not there",
    )
