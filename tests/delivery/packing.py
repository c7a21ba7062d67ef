"""Packing the room, editing it before, and looking into what came out."""

from __future__ import annotations

import zipfile

import pytest
from pxr import Sdf, Usd

from usdbrdf.asset.readers.surfaces import surfaces_from_stage
from usdbrdf.delivery.package import package
from usdbrdf.options import PackageOptions

TIME = Usd.TimeCode.EarliestTime()
CHAIR_FILE = """over "room" {{ over "geo" {{ over "Stuhl_No_1" {{ over "mtl" {{
over "Stuhl_No_1" {{ over "BaseColorTexture" {{
    asset inputs:file = @{}@
}} }} }} }} }} }}"""


def packed(room, tmp_path, name="room.usdz", **options):
    output = tmp_path / "out of it" / name
    package(room.asset.folder, output, PackageOptions(**options))
    return output


def surfaces_of(stage):
    return {s.name: s for s in surfaces_from_stage(stage, TIME, pytest.fail)}


def members(output):
    with zipfile.ZipFile(output) as archive:
        return archive.namelist()


def extracted(output, folder):
    """The package's files: our own readers do not look into archives."""
    with zipfile.ZipFile(output) as archive:
        archive.extractall(folder)
        return Usd.Stage.Open(str(folder / archive.namelist()[0]))


def edit(room, text):
    """Replace the artist's layer; ``text`` may have its braces on one line, which USD may not."""
    lines = text.replace("{", "{\n").replace("}", "\n}\n").replace("(", "(\n").replace(")", "\n)")
    layer = Sdf.Layer.FindOrOpen(str(room.asset.edits_layer))
    layer.ImportFromString(f'#usda 1.0\n(\n    defaultPrim = "room"\n)\n{lines}\n')
    layer.Save()
