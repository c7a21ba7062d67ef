"""What the schemas say on a prim, and where the photographs are."""

from pxr import Usd, UsdGeom

STATUS = "usdBrdf:fit:status"
METHOD = "usdBrdf:fit:method"
TARGET_FRAME = "usdBrdf:fit:targetFrame"
_PINHOLE = "usdBrdf:capture:pinhole"


def fitted_prim(prim):
    """The prim itself or the nearest one above it that was fitted; None where there is none.

    A click may select part of an object.
    """
    while prim and not prim.IsPseudoRoot():
        if _authored(prim, STATUS):
            return prim
        prim = prim.GetParent()
    return None


def facts_of(prim):
    """Attribute name -> value of all that was authored; the schemas' fallbacks are no facts."""
    return {
        attribute.GetName(): attribute.Get()
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetName().startswith("usdBrdf:") and attribute.HasAuthoredValue()
    }


def capture_camera(stage):
    """The camera that holds the photographs, one per time code; None where there is none."""
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Camera) and _authored(prim, _PINHOLE):
            return prim
    return None


def time_code_of_frame(frame):
    """Photograph i, counted from 0, is at time code i + 1."""
    return Usd.TimeCode(frame + 1)


def _authored(prim, name):
    return prim.GetAttribute(name).HasAuthoredValue()
