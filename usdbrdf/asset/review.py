"""What people say of an asset's objects: ``review.usda``, a layer beside edits.usda whose prims
carry a verdict, a comment and a directive for the next run, and the numbers that were judged.

It holds metadata alone (``customData.usdbrdf.review``): whether it is a sublayer or not, the asset
looks the same. Nobody but a person changes it, through the page or by hand."""

from __future__ import annotations

import math
import os
import re
import sys
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd

from usdbrdf.asset.header import Provenance, new_layer, read_header
from usdbrdf.asset.layers.author import export
from usdbrdf.asset.layout import Asset
from usdbrdf.asset.maps import AssetMaps
from usdbrdf.asset.properties import FittedObject
from usdbrdf.asset.readers.compose import open_measured
from usdbrdf.asset.readers.scene import read_fit, read_shading
from usdbrdf.errors import InputRefused, UsdBrdfError
from usdbrdf.files.atomic import environment_failures, publish, temporary_beside
from usdbrdf.files.documents import read_text
from usdbrdf.job.versions import refuse_version
from usdbrdf.model.mesh import DIRECTIVES, IN_PART, OF_SHADE

VERDICTS = ("accept", "reject")
MAX_COMMENT = 2000
# Bytes of the layer, and how deep its prims and dictionaries lie inside each other, at most.
_LARGEST, _DEEPEST = 8 << 20, 200
_STRING = re.compile(r'"""(?:\\.|[^\\])*?"""|"(?:\\.|[^"\\])*"', re.DOTALL)
_VERSION = "1"  # of what is written, not of the program
# A status as older versions called it, of what is bounded or undetermined now.
_OLDER = "prior"
_WORDS = {
    "accept": "accepted", "reject": "rejected", "": "judged",
    "measured": "measured", "bounded": "bounded", "undetermined": "not determined",
    _OLDER: "not determined",
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Of one object: a verdict and a directive, "" for none; a comment; and what was judged: the
    status of its fit, phi and psi (NaN: not known)."""

    verdict: str = ""
    comment: str = ""
    directive: str = ""
    status: str = ""
    phi: float = math.nan
    psi: float = math.nan

    @property
    def says_something(self) -> bool:
        return bool(self.verdict or self.comment or self.directive)

    @property
    def fault(self) -> str:
        """What is wrong with it, in words; "" where nothing is."""
        if self.verdict not in ("", *VERDICTS):
            return f"the verdict {self.verdict!r} is none of {', '.join(VERDICTS)}."
        if self.directive not in ("", *DIRECTIVES):
            return f"the directive {self.directive!r} is none of {', '.join(DIRECTIVES)}."
        if len(self.comment) > MAX_COMMENT:
            return f"the comment has {len(self.comment)} characters, at most {MAX_COMMENT} may be."
        if any(unicodedata.category(c) in ("Cc", "Cs") and c not in "\t\n\r" for c in self.comment):
            # USD stores text up to a zero byte, and a terminal obeys some of them.
            return "the comment holds control characters, or halves of characters."
        return ""

    def change(self, fit: FittedObject | None) -> str:
        """What became of the object since, in words; "" where its numbers are those judged."""
        now = judged_as(fit)
        alike = self.status == now.status or (self.status == _OLDER and now.status in IN_PART)
        same = alike and all(
            _shown(getattr(self, name)) == _shown(getattr(now, name)) for name in ("phi", "psi")
        )
        if not self.says_something or same:
            return ""
        return f"{_WORDS[self.verdict]} as {self._numbers()}; now {now._numbers()}."

    def _numbers(self) -> str:
        known = _WORDS.get(self.status, self.status) if self.status else "unknown"
        return f"{known}, phi {_shown(self.phi)}, psi {_shown(self.psi)}"


def _shown(number: float) -> str:
    return f"{number:.2f}" if math.isfinite(number) else "unknown"


def judged_as(fit: FittedObject | None) -> Judgement:
    """What a person who judges an object now has seen of it."""
    if fit is None:
        return Judgement()
    return Judgement(status=fit.status, phi=fit.phi, psi=fit.psi)


def review_file(asset: Asset) -> Path:
    """Where the layer lies, whether or not it is there."""
    return asset.folder / "review.usda"


def read_review(asset: Asset) -> dict[str, Judgement]:
    """By prim path; empty where nobody has said anything. InputRefused where the layer is no USD
    or says something of another kind; what it says is checked by ``Judgement.fault`` alone."""
    file = review_file(asset)
    if not os.path.lexists(file):
        return {}
    if not file.is_file():
        raise InputRefused(
            f"{file}: this is no regular file, or leads to none, and what people said of the "
            "objects is to be in it. Put the layer there, from a copy of the asset, or remove it. "
            "[review.layer]"
        )
    if (size := file.stat().st_size) > _LARGEST:
        raise InputRefused(
            f"{file}: this has {size:,} bytes, at most {_LARGEST:,} are read. "
            "Delete from it what is no review, or move it away. [review.layer]"
        )
    layer = None
    with suppress(Tf.ErrorException):
        layer = Sdf.Layer.OpenAsAnonymous(str(file)) if _is_plain(file) else None
    if layer is None:
        raise InputRefused(
            f"{file}: this is not a readable USD layer. Correct it, or move it away. [review.layer]"
        )
    found: dict[str, Judgement] = {}

    def visit(path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.PrimSpec) and not path.ContainsPrimVariantSelection():
            record = spec.customData.get("usdbrdf", {})
            said = record.get("review") if isinstance(record, dict) else None
            if said is not None:
                found[str(path)] = _judgement(said, f"{file}: <{path}>")

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return found


def _is_plain(file: Path) -> bool:
    """Whether it is a layer of text that USD's parser survives: it fails on deep nesting."""
    text = _STRING.sub("", read_text(file))
    depth = np.cumsum([{"{": 1, "}": -1}[mark] for mark in re.findall(r"[{}]", text)])
    return text.startswith("#usda") and int(depth.max(initial=0)) <= _DEEPEST


def _judgement(said: Any, subject: str) -> Judgement:
    """A dictionary as a page or a layer has it; InputRefused for values of another kind."""
    known: dict[str, Any] = {}
    for item in fields(Judgement):
        value = said.get(item.name) if isinstance(said, Mapping) else None
        number = isinstance(item.default, float)
        fitting = _is_number(value) if number else isinstance(value, str)
        if not isinstance(said, Mapping) or (value is not None and not fitting):
            raise InputRefused(
                f"{subject}: its review holds something else than a verdict, a comment and a "
                "directive in words. Correct or delete it. [review.layer]"
            )
        if value is not None:
            known[item.name] = float(value) if number else value
    return Judgement(**known)


def _is_number(value: Any) -> bool:
    """Whether it is one that a float can be; JSON has whole numbers of any length."""
    return isinstance(value, float) or (isinstance(value, int) and abs(value) <= sys.float_info.max)


def judgements_of(asset: Asset, said: Any) -> dict[str, Judgement]:
    """What a page says, checked, beside what of each object is there to be judged now: by prim
    path a dictionary of verdict, comment and directive. Of what was judged once and is no object
    any more it may be taken back. InputRefused for anything else."""
    if not isinstance(said, Mapping):
        raise InputRefused("the page's verdicts are no table of objects. [review.page]")
    maps = AssetMaps(open_measured(asset))
    paths = {obj.prim_path for obj in maps.scene.objects}
    before, found = read_review(asset), {}
    for path, record in said.items():
        given, old = _judgement(record, f"<{path}>"), before.get(path)
        if path not in paths and (old is None or given.says_something):
            raise InputRefused(f"<{path}>: no object of this asset has that path. [review.page]")
        if given.fault:
            raise InputRefused(f"<{path}>: {given.fault} [review.page]")
        words = given.verdict, given.comment, given.directive
        if old and words == (old.verdict, old.comment, old.directive):
            found[path] = old  # judged then, of what was there then
        elif given.says_something:
            seen = judged_as(read_fit(maps.stage, path))
            found[path] = Judgement(
                verdict=words[0], comment=words[1], directive=words[2],
                status=seen.status, phi=seen.phi, psi=seen.psi,
            )  # fmt: skip
    # What was said of prims that the page does not show stays.
    return {path: old for path, old in before.items() if path not in said} | found


def write_review(asset: Asset, judgements: Mapping[str, Judgement]) -> None:
    """Write the layer, whole or not at all; equal judgements give equal bytes."""
    refuse_version(asset.folder)
    layer = new_layer(read_header(asset.layer("scan")), Provenance(role="review", version=_VERSION))
    Sdf.CreatePrimInLayer(layer, f"/{asset.name}")
    layer.documentation = "What people said of the objects; written by usdbrdf view and its page."
    for path, judgement in sorted(judgements.items()):
        said = {
            item.name: value
            for item in fields(Judgement)
            if (value := getattr(judgement, item.name)) != "" and value == value
        }
        prim = Sdf.CreatePrimInLayer(layer, path)
        prim.customData = {"usdbrdf": {"review": said}}
    file = review_file(asset)
    with environment_failures(str(file)), temporary_beside(file) as staged:
        export(layer, staged, folder=asset.folder)
        publish(staged, file)


def changes_since(asset: Asset) -> dict[str, str]:
    """By prim path what became of objects since somebody judged them, in words; empty too where
    the review cannot be read, which ``validate`` says."""
    return _changes(asset, _said(asset))


def notes_for_run(asset: Asset) -> list[str]:
    """What a run that measured anew has to tell whoever judged before it, a sentence each."""
    said = _said(asset)
    found = [f"<{path}> {change}" for path, change in _changes(asset, said).items()]
    if not any(one.says_something for one in said.values()):
        return found
    stage = open_measured(asset)
    found += [f"<{path}> {told}" for path, told in followed(stage, said)]
    gone = [path for path in said if not stage.GetPrimAtPath(path)]
    return found + [
        f"<{path}> is no object any more: what is said of it is passed over." for path in gone
    ]


def followed(stage: Usd.Stage, said: Mapping[str, Judgement]) -> Iterator[tuple[str, str]]:
    """By prim path what became of each directive, in words."""
    for path, one in said.items():
        if not one.directive or not stage.GetPrimAtPath(path):
            continue
        of_shade = one.directive in OF_SHADE
        made = read_shading(stage, path) if of_shade else read_fit(stage, path)
        if made is not None and made.directive == one.directive:
            yield path, f"was made as {one.directive!r}, as the directive asks."
        else:
            step = "shade" if of_shade else "fit"
            yield (
                path,
                f"asks for {one.directive!r}, which the step {step} will follow when it runs.",
            )


def _said(asset: Asset) -> dict[str, Judgement]:
    try:
        return read_review(asset)
    except UsdBrdfError:
        return {}


def _changes(asset: Asset, said: Mapping[str, Judgement]) -> dict[str, str]:
    if not said or not asset.layer("material").is_file():
        return {}
    stage, found = open_measured(asset), {}
    for path, judgement in said.items():
        prim = stage.GetPrimAtPath(path)
        if prim and (change := judgement.change(read_fit(stage, path))):
            found[path] = change
    return found
