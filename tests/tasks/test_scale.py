"""Nothing that is measured depends on how large the scene is: an object alone before nothing, 10 cm
and 100 m wide. Powers of two, by which all arithmetic stays exact."""

from __future__ import annotations

import numpy as np

from tests.scenes import edited, make_capture
from usdbrdf.files.ply import write_ply
from usdbrdf.options import ConvertOptions, FitOptions, Sampling, ShadeOptions, TextureOptions
from usdbrdf.pipeline import convert


def _converted(folder, scale):
    """Summaries of all tasks, and the bytes of all maps."""
    capture = make_capture(folder / "capture", room=False, size=(48, 36))
    points = (capture.points * np.float32(scale)).astype(np.float32)
    write_ply(capture.folder / "mesh.ply", points, capture.triangles, capture.face_object)
    with edited(capture.folder / "transforms.json") as document:
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] *= scale
            frame["transform_matrix"] = pose.tolist()
    options = ConvertOptions(
        texture=TextureOptions(max_texels=2000),
        shade=ShadeOptions(denoise="none", sampling=Sampling(max_rays=64)),
        fit=FitOptions(max_pixels=200),
    )
    done = convert(capture.folder, folder / "asset", options)
    told = {name: dict(result.summary) for name, result in done.items()}
    side = told["texture"].pop("texel_size")
    maps = {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted((folder / "asset").rglob("*.exr"))
    }
    return side, told, maps


def test_ten_centimetres_and_a_hundred_metres_give_the_same_numbers(tmp_path):
    small_side, small, small_maps = _converted(tmp_path / "small", 0.125)
    large_side, large, large_maps = _converted(tmp_path / "large", 128.0)
    assert large_side == 1024 * small_side
    assert large == small
    assert len(small_maps) > 5
    assert large_maps == small_maps
