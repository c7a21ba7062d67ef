"""Open Image Denoise (extra ``denoise``): whether it is there, and its lightmap filter over one
object's atlas."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from usdbrdf.errors import EnvironmentFailure

Float = npt.NDArray[np.float32]
AUTO: Final = "auto"
NONE: Final = "none"
OIDN: Final = "oidn"
CHOICES: Final = (AUTO, NONE, OIDN)

# Larger lightmaps than this suffices for are filtered in tiles.
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
    import pyoidn

    # Not pyoidn.denoise, which keeps its working memory, up to 2.4 GiB, until the process ends.
    with pyoidn.Device() as device:
        device.commit()
        lightmap_filter = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT_LIGHTMAP)
        try:  # not "with": its filters swallow errors
            lightmap_filter.set_int("maxMemoryMB", _MOST_MEGABYTES)
            for picture in pictures:
                colour = np.ascontiguousarray(picture, np.float32)
                filtered = np.empty_like(colour)
                lightmap_filter.set_image("color", colour, pyoidn.OIDN_FORMAT_FLOAT3)
                lightmap_filter.set_image("output", filtered, pyoidn.OIDN_FORMAT_FLOAT3)
                lightmap_filter.commit()
                lightmap_filter.execute()
                error = device.get_error()
                if error is not None:
                    raise EnvironmentFailure(
                        f"Open Image Denoise failed on a lightmap of {picture.shape[1]} x "
                        f"{picture.shape[0]} texels: {error}. Run again with --denoise none. "
                        "[shading.denoise]"
                    )
                yield np.maximum(filtered, 0, out=filtered)
        finally:
            lightmap_filter.release()
