"""Open Image Denoise (extra ``denoise``): whether it is there, and its filters of lightmaps and of
rendered pictures."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final, Literal

import numpy as np

from usdbrdf.errors import EnvironmentFailure
from usdbrdf.model.arrays import Float

AUTO: Final = "auto"
NONE: Final = "none"
OIDN: Final = "oidn"
# Larger pictures than this suffices for are filtered in tiles.
_MOST_MEGABYTES = 512


def chosen_filter(wanted: str) -> Literal["none", "oidn"]:
    """What ``--denoise`` means on this machine: auto is oidn where pyoidn can be imported.
    Raises EnvironmentFailure with the cure where oidn is wanted and cannot."""
    if wanted == NONE:
        return NONE
    try:
        import pyoidn  # noqa: F401
    except (ImportError, OSError) as error:  # OSError: a library of its own that does not load
        if wanted == AUTO:
            return NONE
        raise EnvironmentFailure(
            "--denoise oidn needs Open Image Denoise, which is not installed. "
            "Run: pip install 'usdbrdf[denoise]'. [shading.denoise]"
        ) from error
    return OIDN


def denoise_lightmaps(pictures: Iterable[Float]) -> Iterator[Float]:
    """Filtered copies of HDR lightmaps (H, W, 3) float32 whose gutters are dilated.

    The same bits in every run on one machine, with any number of threads. Raises
    EnvironmentFailure where Open Image Denoise gives up, as without memory.
    """
    return _filtered("RTLightmap", (), ({"color": picture} for picture in pictures))


def denoise_picture(radiance: Float, albedo: Float, normal: Float) -> Float:
    """Radiance (H, W, 3) filtered along the edges of the first surfaces' albedo and normals,
    (H, W, 3) float32 each, which are all but free of noise. Otherwise as ``denoise_lightmaps``."""
    images = {"color": radiance, "albedo": albedo, "normal": normal}
    (filtered,) = _filtered("RT", ("hdr", "cleanAux"), [images])
    return filtered


def _filtered(
    filter_type: str, switches: tuple[str, ...], pictures: Iterable[dict[str, Float]]
) -> Iterator[Float]:
    """The "color" of each of the ``pictures``, filtered."""
    import pyoidn

    # Not pyoidn.denoise, which keeps its working memory, up to 2.4 GiB, until the process ends.
    with pyoidn.Device() as device:
        device.commit()
        oidn_filter = pyoidn.Filter(device, filter_type)
        try:  # not "with": its filters swallow errors
            oidn_filter.set_int("maxMemoryMB", _MOST_MEGABYTES)
            for switch in switches:
                oidn_filter.set_bool(switch, True)
            for images in pictures:
                given = {k: np.ascontiguousarray(v, np.float32) for k, v in images.items()}
                filtered = np.empty_like(given["color"])
                for name, image in {**given, "output": filtered}.items():
                    oidn_filter.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
                oidn_filter.commit()
                oidn_filter.execute()
                error = device.get_error()
                if error is not None:
                    raise EnvironmentFailure(
                        f"Open Image Denoise failed on a picture of {filtered.shape[1]} x "
                        f"{filtered.shape[0]} pixels: {error}. Run again with --denoise none. "
                        "[shading.denoise]"
                    )
                yield np.maximum(filtered, 0, out=filtered)
        finally:
            oidn_filter.release()
