"""The light from outside the scan, as the user names it."""

from __future__ import annotations

from pathlib import Path

from usdbrdf.errors import InputRefused
from usdbrdf.files.colour import WORKING_SPACE, to_working_space
from usdbrdf.files.images import read_radiance
from usdbrdf.shading.environment import Environment, black_environment
from usdbrdf.steps.step import hash_of_files


def environment_from_file(picture: Path | None, up_axis: str) -> Environment:
    """A latitude-longitude HDR picture in the working space, or black for None."""
    if picture is None:
        return black_environment()
    image = to_working_space(read_radiance(picture), WORKING_SPACE)
    return Environment(image=image, z_up=up_axis == "Z")


def environment_hash(picture: Path | None) -> dict[str, str]:
    """The picture's entry in a step's inputs."""
    if picture is None:
        return {}
    if not picture.is_file():
        raise InputRefused(f"{picture}: no such file. Check --environment. [shading.environment]")
    return {"environment": hash_of_files([picture])}
