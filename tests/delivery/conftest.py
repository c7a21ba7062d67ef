"""The small asset of the tests, with maps whose texels differ, to be packed."""

import numpy as np
import pytest

from usdbrdf.files.images import write_exr


@pytest.fixture
def room(built):
    """The asset, its lamp at most 8 bright, its chair with a map of colours."""
    folder = built.asset.folder
    colours = np.random.default_rng(5).random((8, 6, 3)).astype(np.float32)
    write_exr(folder / "textures/Stuhl_No_1.base_color.exr", colours)
    emission = np.tile(np.float32([8.0, 4.0, 2.0]), (4, 4, 1))
    emission[0] *= 0.25
    write_exr(folder / "textures/lamp.emission.exr", emission)
    return built
