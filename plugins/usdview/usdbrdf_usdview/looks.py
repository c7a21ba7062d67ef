"""The variant set ``look``, wherever the asset stands in the stage."""

from pxr import Usd

VARIANT_SET = "look"


def look_prim(usdviewApi):
    """The selected prim or the nearest one above it that has looks, else the default prim; None
    where neither has."""
    stage = usdviewApi.stage
    if not stage:
        return None
    prim = usdviewApi.prim
    while prim and not prim.IsPseudoRoot():
        # Within an instance nothing can be selected.
        if _has_looks(prim) and not prim.IsInstanceProxy():
            return prim
        prim = prim.GetParent()
    prim = stage.GetDefaultPrim()
    return prim if prim and _has_looks(prim) else None


def looks_of(prim):
    """Names of the looks of what ``look_prim`` found."""
    return tuple(prim.GetVariantSet(VARIANT_SET).GetVariantNames()) if prim else ()


def switch_look(prim, look):
    """Select a look in the session layer, which is never saved with the asset."""
    stage = prim.GetStage()
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        prim.GetVariantSet(VARIANT_SET).SetVariantSelection(look)


def _has_looks(prim):
    return prim.GetVariantSets().HasVariantSet(VARIANT_SET)
