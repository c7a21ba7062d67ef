"""Writing scene description straight into a layer: prims, attributes, relationships; and from a
layer in memory to a file that has been opened again and composes.

A layer is written as it will lie on disk, with nothing composed: no opinion can come from
anywhere but these calls, and equal calls give equal bytes."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Sdf, Tf, Usd, UsdUtils

from usdbrdf.asset.properties import Fact, known_facts
from usdbrdf.asset.readers.compose import in_one_line
from usdbrdf.asset.readers.tried import wrote
from usdbrdf.errors import EnvironmentFailure, InputRefused, UsdBrdfError
from usdbrdf.files.atomic import cure_of_writing, environment_failures, sha256_of, temporary_beside

Types = Sdf.ValueTypeNames
# As USD names a file that it was to compose; between @@@ a name that holds an @, in some versions.
_NOT_OPENED = re.compile(r"Could not open asset @(?:@@)?(?P<file>.+?)@(?:@@)? for ")


def over(layer: Sdf.Layer, path: str) -> Sdf.PrimSpec:
    """The prim spec at a path, created as an ``over`` with its ancestors if absent."""
    return Sdf.CreatePrimInLayer(layer, Sdf.Path(path))


def define(layer: Sdf.Layer, path: str, type_name: str) -> Sdf.PrimSpec:
    """A ``def``, of a type unless that is ""; its ancestors stay what they are."""
    prim = over(layer, path)
    prim.specifier = Sdf.SpecifierDef
    if type_name:
        prim.typeName = type_name
    return prim


def inside(variant: Sdf.Path, path: str) -> str:
    """The path of a prim as a variant of a prim above it has it."""
    return str(Sdf.Path(path).ReplacePrefix(variant.GetPrimPath(), variant))


def apply_schema(prim: Sdf.PrimSpec, *names: str) -> None:
    """Append applied API schemas to the prim's own list, each once."""
    present = prim.GetInfo("apiSchemas").prependedItems if prim.HasInfo("apiSchemas") else []
    added = [name for name in names if name not in present]
    if added:
        items = Sdf.TokenListOp.Create(prependedItems=[*present, *added])
        prim.SetInfo("apiSchemas", items)


def attribute(
    prim: Sdf.PrimSpec,
    name: str,
    type_name: Sdf.ValueTypeName,
    value: Any = None,
    *,
    uniform: bool = False,
    samples: Mapping[float, Any] | None = None,
    interpolation: str = "",
) -> Sdf.AttributeSpec:
    """An attribute with a default value and, per time code, samples. A numpy array becomes the
    array of its type; its numbers are of that type already."""
    variability = Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying
    spec = prim.attributes.get(name)
    if spec is None:
        spec = Sdf.AttributeSpec(prim, name, type_name, variability, declaresCustom=False)
    if isinstance(value, np.ndarray):
        value = type(type_name.defaultValue).FromNumpy(np.ascontiguousarray(value))
    if value is not None:
        spec.default = value
    for time, sample in (samples or {}).items():
        prim.layer.SetTimeSample(spec.path, time, sample)
    if interpolation:
        spec.SetInfo("interpolation", interpolation)
    return spec


def attribute_per_frame(
    prim: Sdf.PrimSpec,
    name: str,
    type_name: Sdf.ValueTypeName,
    values: Sequence[Any],
    *,
    always: bool = False,
) -> None:
    """An attribute that has ``values[i]`` at time code i + 1, and the first by default. Without
    ``always`` a constant gets no samples: it is easier to override then."""
    varies = always or any(value != values[0] for value in values)
    samples = {float(i + 1): value for i, value in enumerate(values)} if varies else {}
    attribute(prim, name, type_name, values[0], samples=samples)


def author_fact(prim: Sdf.PrimSpec, fact: Fact, value: Any, instance: str = "") -> None:
    """One attribute of ours with its schema; of a fact with samples a value per frame."""
    apply_schema(prim, fact.schema.applied(instance))
    name, type_name = fact.attribute(instance), Types.Find(fact.type)
    made = type(type_name.defaultValue)

    def convert(plain: Any) -> Any:
        return made(*np.asarray(plain).tolist()) if hasattr(made, "dimension") else made(plain)

    if fact.samples:
        values, always = [convert(each) for each in value], fact.samples == "every"
        attribute_per_frame(prim, name, type_name, values, always=always)
    else:
        attribute(prim, name, type_name, convert(value), uniform=fact.is_uniform)


def author_record(prim: Sdf.PrimSpec, record: Any, instance: str = "") -> None:
    """What a record has to say (see ``properties``), and its maps: an ``instance`` for each."""
    for fact, value in known_facts(record):
        author_fact(prim, fact, value, instance)
    for aov in getattr(record, "aovs", ()):
        author_record(prim, aov, aov.name)


def relationship(prim: Sdf.PrimSpec, name: str, *targets: str) -> Sdf.RelationshipSpec:
    """A relationship to these targets; without any it has no opinion about them."""
    spec = prim.relationships.get(name) or Sdf.RelationshipSpec(prim, name, custom=False)
    if targets:
        spec.targetPathList.explicitItems = [_composed(target) for target in targets]
    return spec


def connect(
    prim: Sdf.PrimSpec, name: str, type_name: Sdf.ValueTypeName, source: str
) -> Sdf.AttributeSpec:
    """An attribute that takes its value from the output at path ``source``."""
    spec = attribute(prim, name, type_name)
    spec.connectionPathList.explicitItems = [_composed(source)]
    return spec


def _composed(target: str) -> Sdf.Path:
    """A target as layers state it: where it is in the stage, though in a variant."""
    return Sdf.Path(target).StripAllVariantSelections()


def author_inputs(prim: Sdf.PrimSpec, type_name: Sdf.ValueTypeName, **values: Any) -> None:
    """Inputs of a shader or a light that share a type, by their names."""
    for name, value in values.items():
        attribute(prim, f"inputs:{name}", type_name, value)


def export(layer: Sdf.Layer, path: Path, *, folder: Path) -> None:
    """Write ``layer`` to ``path``, in the format of its suffix, checked before it gets the name.

    folder   where the layer will lie once published; its relative paths are judged from there

    When the disk is full USD leaves a truncated file in place of the old one: hence a name beside.
    """
    with temporary_beside(path) as written:
        cause = None
        try:
            done = layer.Export(str(written))
            stored = Sdf.Layer.OpenAsAnonymous(str(written)) if done else None
        except Tf.ErrorException as error:
            stored, cause = None, error
        if not stored or stored.defaultPrim != layer.defaultPrim:
            raise EnvironmentFailure(
                f"{path}: the USD layer could not be written completely. "
                f"{cure_of_writing(written)}, then run the same command again. [environment.io]"
            ) from cause

        def absolute(asset: str) -> str:
            return os.path.normpath(folder / asset) if asset.startswith(("./", "../")) else asset

        UsdUtils.ModifyAssetPaths(stored, absolute)
        # Each layer is checked when it is written; what lies there now may be damaged, about to be
        # replaced, or the artist's. So for payloads.
        stored.subLayerPaths = []
        stage = Usd.Stage.Open(stored, Usd.Stage.LoadNone)
        if errors := stage.GetCompositionErrors():
            for named in filter(None, map(_NOT_OPENED.search, map(str, errors))):
                _refuse_damaged(named["file"])
            raise UsdBrdfError(
                f"{path.name}: the layer does not compose: {in_one_line(errors[0])}. This is a "
                "defect of usdbrdf; please report it. [stage.composition]"
            )
        os.replace(written, path)
    wrote(path)


def _refuse_damaged(asset: str) -> None:
    """Say of a file that USD could not compose whether its disk or its content is at fault: the
    latter where its bytes can be read and USD opens it no more than before. One that is not there
    is left to the caller."""
    file = Path(Ar.SplitPackageRelativePathOuter(asset)[0])
    if not file.is_file():
        return
    with environment_failures(str(file)):
        sha256_of(file)
    try:
        opened = Sdf.Layer.OpenAsAnonymous(asset)
        why = "it is not a layer"
    except Tf.ErrorException as error:
        opened, why = None, in_one_line(error)
    if opened:
        raise EnvironmentFailure(
            f"{file}: USD could read the layer at the second attempt only. Check the disk, then "
            "run the same command again; finished work is kept. [environment.io]"
        )
    raise InputRefused(
        f"{file}: USD cannot open it: {why}. Correct that file or export it again, then run the "
        "same command again. [stage.input]"
    )
