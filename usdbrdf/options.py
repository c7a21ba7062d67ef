"""What can be said on the command line: every option's name, unit and default, and the frozen
option values of the steps that they become.

An option that several commands have is defined once, so it means the same everywhere.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from usdbrdf.capture.ingest_options import IngestOptions
from usdbrdf.errors import InputRefused
from usdbrdf.tasks.shade import ShadeOptions
from usdbrdf.tasks.texture import TextureOptions
from usdbrdf.transport.denoise import CHOICES
from usdbrdf.transport.irradiance import Sampling

# The paper's number of independent directions per texel.
_COSINE_RAYS = 10_000


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Options of every command that writes into an asset folder."""
    add_talk_options(parser)
    add = parser.add_argument
    add(
        "--wait",
        type=finite_number,
        default=0.0,
        metavar="S",
        help="wait up to this many seconds for a busy asset folder",
    )
    parser.set_defaults(hand_edits="refuse")


def add_talk_options(parser: argparse.ArgumentParser) -> None:
    """What is said while a command runs and at its end."""
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.add_argument(
        "--json", action="store_true", help="print a summary as JSON to stdout, nothing else"
    )


def add_edit_options(parser: argparse.ArgumentParser) -> None:
    """What to do about files of ours that somebody changed: only for the command that can write
    all of them again."""
    edits = parser.add_mutually_exclusive_group()
    edits.add_argument(
        "--adopt",
        action="store_const",
        const="adopt",
        dest="hand_edits",
        default="refuse",
        help="keep changes made by hand to files of ours as adopted-N.usda; default: refuse to run",
    )
    edits.add_argument(
        "--discard",
        action="store_const",
        const="discard",
        dest="hand_edits",
        help="drop changes made by hand to files of ours",
    )


def add_ingest_options(parser: argparse.ArgumentParser) -> None:
    known = IngestOptions()
    add = parser.add_argument_group("ingest").add_argument
    add("--adapter", metavar="NAME", help="capture format; default: recognised by its content")
    add("--no-plugins", action="store_true", help="use our own adapters only")
    add("--mesh", type=existing_file, metavar="FILE", help="mesh; default: the capture's own")
    add(
        "--objects",
        type=existing_file,
        metavar="FILE",
        help="object names; default: the capture's own",
    )
    add(
        "--crease-angle",
        type=finite_number,
        default=known.crease_angle_deg,
        metavar="DEG",
        help="faces that meet at more degrees than this meet in a sharp edge",
    )
    add(
        "--decimate",
        type=int,
        metavar="N",
        help="reduce the mesh to about N triangles; default: keep all",
    )
    add(
        "--min-component-area",
        type=finite_number,
        default=known.min_component_area_m2,
        metavar="M2",
        help="without labels, connected parts of at least this many m^2 become objects",
    )
    add(
        "--assume-srgb",
        action="store_true",
        help="accept 8-bit photographs as sRGB; the result is then not radiometric",
    )
    add(
        "--encoding",
        metavar="NAME",
        help="colour space of the images, e.g. lin_ap1_scene; default: as the format says",
    )
    add(
        "--pose-scale",
        type=finite_number,
        metavar="S",
        help="scale of the camera axes, to be divided out; default: 1, others are refused",
    )
    add(
        "--max-nonfinite",
        type=finite_number,
        default=known.max_nonfinite,
        metavar="SHARE",
        help="drop a frame with a larger share of NaN or infinite pixels",
    )
    add(
        "--allow-outside",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="let the capture name files in this folder too; may be given again; default: none",
    )
    add(
        "--meters-per-unit",
        type=finite_number,
        metavar="M",
        help="length of a scene unit in metres; default: as the format says",
    )
    add("--up-axis", choices=("Y", "Z"), help="axis that points up; default: as the format says")


def add_texture_options(parser: argparse.ArgumentParser) -> None:
    known = TextureOptions()
    add = parser.add_argument_group("texture").add_argument
    add(
        "--texel-size",
        type=finite_number,
        metavar="M",
        help="side of a texel in metres; default: the frames' median pixel footprint",
    )
    add(
        "--quantile",
        type=finite_number,
        default=known.quantile,
        metavar="P",
        help="quantile of a texel's observations that becomes L_d, between 0 and 1",
    )
    add(
        "--max-texels",
        type=int,
        default=known.max_texels,
        metavar="N",
        help="coarsen the default texel size so that the scene has at most N texels",
    )


def add_memory_option(parser: argparse.ArgumentParser) -> None:
    """Of the steps that read all frames."""
    parser.add_argument(
        "--memory",
        type=finite_number,
        metavar="GIB",
        help="memory for texturing and for refining, which then take as many passes over the "
        "frames as that asks for; default: three quarters of the machine's",
    )


def add_shade_options(parser: argparse.ArgumentParser) -> None:
    known = ShadeOptions()
    add = parser.add_argument_group("shade").add_argument
    add(
        "--sampling",
        choices=("mis", "cosine"),
        default=known.sampling.estimator,
        help="mis: lights and cosine combined, Sobol points; cosine: the paper's estimator",
    )
    add(
        "--standard-error",
        type=finite_number,
        default=known.sampling.standard_error,
        metavar="E",
        help="mis stops where the relative standard error of S is below this, or 1.5 times as much "
        "where S is filtered",
    )
    add(
        "--rays",
        type=int,
        metavar="N",
        help="rays per texel: with mis at most this many, "
        f"default: {known.sampling.max_rays}; with cosine exactly, default: {_COSINE_RAYS}",
    )
    add(
        "--denoise",
        choices=CHOICES,
        default=known.denoise,
        help="lightmap filter for S; oidn needs usdbrdf[denoise], auto takes it where it is there",
    )


def add_light_options(parser: argparse.ArgumentParser) -> None:
    """What all that traces light shares."""
    add = parser.add_argument_group("light transport").add_argument
    add(
        "--environment",
        type=existing_file,
        metavar="HDR",
        help="latitude-longitude picture of the surroundings; default: black",
    )
    add(
        "--seed",
        type=seed_number,
        default=ShadeOptions().sampling.seed,
        metavar="N",
        help="seed of the random numbers",
    )


def ingest_options(chosen: argparse.Namespace) -> IngestOptions:
    return IngestOptions(
        mesh=chosen.mesh,
        objects=chosen.objects,
        crease_angle_deg=chosen.crease_angle,
        decimate=chosen.decimate,
        min_component_area_m2=chosen.min_component_area,
        assume_srgb=chosen.assume_srgb,
        encoding=chosen.encoding,
        pose_scale=chosen.pose_scale,
        max_nonfinite=chosen.max_nonfinite,
        allow_outside=tuple(chosen.allow_outside),
        meters_per_unit=chosen.meters_per_unit,
        up_axis=chosen.up_axis,
    )


def texture_options(chosen: argparse.Namespace) -> TextureOptions:
    return TextureOptions(
        texel_size=chosen.texel_size,
        quantile=chosen.quantile,
        max_texels=chosen.max_texels,
        memory=chosen.memory,
    )


def shade_options(chosen: argparse.Namespace) -> ShadeOptions:
    rays = chosen.rays
    if rays is None:
        paper = chosen.sampling == "cosine"
        rays = _COSINE_RAYS if paper else ShadeOptions().sampling.max_rays
    sampling = Sampling(
        estimator=chosen.sampling,
        standard_error=chosen.standard_error,
        max_rays=rays,
        seed=chosen.seed,
    )
    return ShadeOptions(sampling=sampling, denoise=chosen.denoise, environment=chosen.environment)


def seed_number(text: str) -> int:
    if not (text.isdecimal() and int(text) < 2**32):
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 to 4294967295")
    return int(text)


def finite_number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r} is not a finite number")
    return value


def existing_file(text: str) -> Path:
    # Said before any work is done; an input that is not there is refused as a capture would be.
    if not Path(text).is_file():
        raise InputRefused(f"{text}: no such file. Check the path. [usage.file]")
    return Path(text)
