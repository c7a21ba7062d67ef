"""Rules about the capture: its camera, and the texture coordinates of its objects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pxr import Usd, UsdGeom

from usdbrdf.asset.layers.scan_layer import lens_from_pinhole
from usdbrdf.asset.readers.scene import LENS, authored
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import Fault, Severity, Site, cure, rule

_TOLERANCE = 1e-3
_UV_TOLERANCE = 1e-4
_EXPOSURE = ("exposure", *(f"exposure:{n}" for n in ("time", "fStop", "iso", "responsivity")))
_PINHOLE = ("usdBrdf:capture:pinhole", "usdBrdf:capture:resolution")


@cure("exposure:responsivity")
def scale_to_one(site: Site) -> bool:
    camera = UsdGeom.Camera(site)
    responsivity = camera.GetExposureResponsivityAttr()
    scales = {time: camera.ComputeLinearExposureScale(time) for time in _times(site, _EXPOSURE)}
    if not all(scales.values()):
        return False
    cured = {time: responsivity.Get(time) / scale for time, scale in scales.items()}
    done = [responsivity.Set(value, time) for time, value in cured.items()]
    return all(done)


@rule(
    Severity.ERROR,
    advice="Author exposure:responsivity so that the product is 1, and use a camera of your own "
    "for another exposure.",
    cure=scale_to_one,
)
def camera_exposure(scene: AssetStage) -> Iterator[Fault]:
    """The exposure attributes of the capture camera multiply to 1 at every time. Its photographs
    are radiance already; renderers that honour the attributes would show the asset brighter or
    darker than the photographs."""
    for prim in scene.cameras:
        camera = UsdGeom.Camera(prim)
        times = _times(prim, _EXPOSURE)
        scales = [camera.ComputeLinearExposureScale(time) for time in times] if camera else []
        wrong = [scale for scale in scales if abs(scale - 1.0) > _TOLERANCE]
        if wrong:
            yield Fault(
                prim,
                f"the exposure scale is {wrong[0]:.4g} instead of 1 at {len(wrong)} of "
                f"{len(scales)} times: the photographs are radiance already.",
            )


@rule(
    Severity.ERROR,
    advice="Remove the opinions on the lens, and use a camera of your own for another view.",
)
def camera_lens(scene: AssetStage) -> Iterator[Fault]:
    """Focal length, apertures and offsets of the capture camera show what its recorded pinhole
    shows. Renderers use the first, usdbrdf the second: where they differ, pictures and photographs
    do not lie over each other."""
    metres = UsdGeom.GetStageMetersPerUnit(scene.stage)
    for prim in scene.cameras:
        for time in _times(prim, (*LENS, *_PINHOLE)):
            pinhole, size = (prim.GetAttribute(name).Get(time) for name in _PINHOLE)
            lens = [prim.GetAttribute(name).Get(time) for name in LENS]
            if pinhole is None or size is None or not all([*list(size), *pinhole[:2]]):
                yield Fault(prim, "it states no pinhole, or no size of the pictures.")
                break
            if None in lens or not _same_view(lens, lens_from_pinhole(pinhole, size, metres)):
                yield Fault(
                    prim,
                    f"focal length and apertures at time {time} are not those of "
                    "usdBrdf:capture:pinhole.",
                )
                break


def _same_view(lens: Sequence[float], expected: Sequence[float]) -> bool:
    """Lengths mean nothing by themselves: only in widths of the aperture."""
    if not lens[1] or not expected[1]:
        return False
    ratios = np.array(lens, float) / lens[1] - np.array(expected, float) / expected[1]
    return bool(np.abs(ratios).max() < _TOLERANCE)


def _times(prim: Usd.Prim, names: Sequence[str]) -> list[Usd.TimeCode]:
    """Those of all samples of some attributes, and the default."""
    attributes = [prim.GetAttribute(name) for name in names]
    samples = {time for attribute in attributes if attribute for time in attribute.GetTimeSamples()}
    return [Usd.TimeCode.Default(), *map(Usd.TimeCode, sorted(samples))]


@rule(
    Severity.ERROR,
    advice="Remove the opinions on primvars:st or on the mesh; after a change of the geometry run "
    "usdbrdf convert.",
)
def texture_coordinates(scene: AssetStage) -> Iterator[Fault]:
    """Objects with maps have primvars:st, one value per corner, from 0 to 1. Without them, or after
    a change of the mesh that did not carry them along, every texture is shown in the wrong place.
    """
    for item in scene.objects:
        if authored(item, "usdBrdf:texturing:texelSize") is not None:
            problem = _problem_of(UsdGeom.PrimvarsAPI(item).GetPrimvar("st"), item)
            if problem:
                yield Fault(item, problem)


def _problem_of(st: UsdGeom.Primvar, item: Usd.Prim) -> str:
    """ "" for texture coordinates that the maps can be read with."""
    values = st.ComputeFlattened() if st and st.HasValue() else None
    if values is None or not len(values):
        return "it has maps, but no texture coordinates (primvars:st)."
    corners = sum(UsdGeom.Mesh(item).GetFaceVertexCountsAttr().Get() or ())
    if st.GetInterpolation() != UsdGeom.Tokens.faceVarying or len(values) != corners:
        return (
            f"primvars:st has {len(values)} values, {st.GetInterpolation()}, for {corners} corners."
        )
    uv = np.asarray(values, np.float64)
    if not np.isfinite(uv).all():
        return "primvars:st holds values that are no numbers."
    low, high = float(uv.min()), float(uv.max())
    if low < -_UV_TOLERANCE or high > 1.0 + _UV_TOLERANCE:
        return f"primvars:st goes from {low:.4g} to {high:.4g}; the maps from 0 to 1."
    return ""


RULES = (camera_exposure, camera_lens, texture_coordinates)
