"""What people ask of the steps, object by object: in review.usda, or else in the objects.json that
the capture came with (key ``directive``).

ignore    the object keeps its geometry, is not fitted and not published as measured
metal     a conductor is fitted to it
glass     it is not fitted, and shown as a clear dielectric
lamp, not-lamp   it shines by itself, or does not, whatever its radiance says
refit     it is fitted with other random numbers
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pxr import Usd

from usdbrdf.asset.layout import Asset
from usdbrdf.asset.readers.scene import authored
from usdbrdf.asset.review import read_review, review_file
from usdbrdf.errors import InputRefused
from usdbrdf.job.stamp import read_stamp, stamp_path
from usdbrdf.model.scene import SceneObject


def directives_of(asset: Asset, stage: Usd.Stage, words: Sequence[str]) -> dict[str, str]:
    """Of these ``words`` what is asked, by the object's identifier; what a person said in
    review.usda counts before what the capture says.

    Raises InputRefused where review.usda cannot be read or asks what nobody can do.
    """
    stamp = read_stamp(stamp_path(asset.folder, 1, "ingest"))
    told = stamp.summary.get("directives") if stamp else None
    asked: dict[str, str] = dict(told) if isinstance(told, dict) else {}
    for path, said in read_review(asset).items():
        if said.fault:
            raise InputRefused(
                f"{review_file(asset)}: <{path}>: {said.fault} Correct or delete it. [review.layer]"
            )
        prim = stage.GetPrimAtPath(path)
        identifier = authored(prim, "usdBrdf:identifier") if prim else None
        if said.directive and identifier:
            asked[str(identifier)] = said.directive
    return {name: word for name, word in sorted(asked.items()) if word in words}


def by_number(asked: Mapping[str, str], objects: Sequence[SceneObject]) -> dict[int, str]:
    """What is asked of objects, by their numbers in the scene."""
    known = ((i, asked.get(obj.identifier, "")) for i, obj in enumerate(objects))
    return {i: word for i, word in known if word}
