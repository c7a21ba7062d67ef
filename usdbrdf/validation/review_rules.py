"""Rules about what people said of an asset's objects in review.usda."""

from __future__ import annotations

from collections.abc import Iterator

from pxr import Sdf

from usdbrdf.asset.readers.scene import read_fit
from usdbrdf.asset.review import Judgement, followed, read_review, review_file
from usdbrdf.errors import InputRefused
from usdbrdf.validation.rule import AssetStage, Fault, Severity, rule


def _review(scene: AssetStage) -> dict[str, Judgement]:
    """Nothing where it cannot be read, of which ``review_record`` tells."""
    try:
        return read_review(scene.asset) if scene.asset else {}
    except InputRefused:
        return {}


@rule(Severity.ERROR)
def review_record(scene: AssetStage) -> Iterator[Fault]:
    """review.usda can be read, says of objects of this asset what may be said of them, and nothing
    else: a verdict that is no word of ours is one that no run and no page respects.

    Correct the layer, or judge the object again on the page of usdbrdf view."""
    if not scene.asset or not scene.asset_root:
        return
    file = review_file(scene.asset)
    try:
        said = read_review(scene.asset)
    except InputRefused as refusal:
        yield Fault(scene.asset_root, str(refusal))
        return
    known = {str(prim.GetPath()): prim for prim in scene.objects}
    for path, judgement in said.items():
        if path not in known and not _is_measured(scene, path):
            yield Fault(scene.asset_root, f"{file.name} judges <{path}>, which is no object.")
        elif judgement.fault:
            yield Fault(
                known.get(path, scene.asset_root), f"in {file.name} of <{path}> {judgement.fault}"
            )


def _is_measured(scene: AssetStage, path: str) -> bool:
    """Whether it is an object to the layers of the steps: an artist may set any of them aside."""
    label = Sdf.Path(path).AppendProperty("usdBrdf:label")
    return any(layer.GetAttributeAtPath(label) for layer in scene.own_layers)


@rule(Severity.INFO)
def review_directives(scene: AssetStage) -> Iterator[Fault]:
    """What a person asked of an object has been done, and nothing of it is left to a next run.

    Run `usdbrdf convert` again, or the step that is named."""
    for path, told in followed(scene.stage, _review(scene)):
        yield Fault(scene.stage.GetPrimAtPath(path), told)


@rule(Severity.WARNING)
def review_rejected(scene: AssetStage) -> Iterator[Fault]:
    """No object was rejected by the person who looked at it. What was rejected is in the asset all
    the same: nothing that is measured depends on a verdict.

    Override the object's material in edits.usda, or capture it again."""
    said = _review(scene)
    for prim in scene.objects:
        judgement = said.get(str(prim.GetPath()))
        if judgement and judgement.verdict == "reject":
            told = f": {judgement.comment}" if judgement.comment else ""
            yield Fault(prim, f"it was rejected{' '.join(told.split())}.")


@rule(Severity.INFO)
def review_outdated(scene: AssetStage) -> Iterator[Fault]:
    """An object that somebody judged still has the numbers that were judged. After another run a
    verdict may be about something that is not there any more.

    Judge the object again on the page of usdbrdf view."""
    said = _review(scene)
    for prim in scene.objects:
        path = str(prim.GetPath())
        judgement = said.get(path)
        if judgement and (change := judgement.change(read_fit(scene.stage, path))):
            yield Fault(prim, change)
