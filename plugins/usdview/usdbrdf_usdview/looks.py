"""The variant set ``look`` on a stage's default prim."""

from pxr import Usd

VARIANT_SET = "look"


def looks_of(stage):
    """Names of the looks; none where there is no stage, or it is not one of ours."""
    prim = stage.GetDefaultPrim() if stage else None
    if not prim:
        return ()
    return tuple(prim.GetVariantSet(VARIANT_SET).GetVariantNames())


def switch_look(stage, look):
    """Select a look in the session layer, which is never saved with the asset."""
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        stage.GetDefaultPrim().GetVariantSet(VARIANT_SET).SetVariantSelection(look)
