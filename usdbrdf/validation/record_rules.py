"""Rules about what the layers state: of the capture, its camera and texture coordinates; and of a
measurement, made from the rows of ``asset.properties``: ranges, words, that every attribute is one
of ours, and what several of them say together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import chain

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from usdbrdf.asset.layers.scan_layer import lens_from_pinhole
from usdbrdf.asset.properties import FIT, INSTANCE, SHADING, TEXTURING, Fact, facts_by_attribute
from usdbrdf.asset.readers.scene import LENS, authored
from usdbrdf.validation.rule import AssetStage, Fault, Severity, Site, cure, rule

# Of a scale, and of the lens.
_TOLERANCE = 1e-3
_UV_TOLERANCE = 1e-4
_EXPOSURE = ("exposure", *(f"exposure:{n}" for n in ("time", "fStop", "iso", "responsivity")))
_PINHOLE = ("usdBrdf:capture:pinhole", "usdBrdf:capture:resolution")
# What each step but the first says of every object.
_MEASURED = tuple(schema.attribute(schema.key) for schema in (TEXTURING, SHADING, FIT))
# The table, by the attributes' names.
FACTS = facts_by_attribute()
# By the names of older versions.
_OLDER = {
    f"{fact.schema.namespace}:{fact.formerly}": fact for fact in FACTS.values() if fact.formerly
}


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


@rule(Severity.ERROR, scale_to_one)
def camera_exposure(scene: AssetStage) -> Iterator[Fault]:
    """The exposure attributes of the capture camera multiply to 1 at every time. Its photographs
    are radiance already; renderers that honour the attributes would show the asset brighter or
    darker than the photographs.

    Author exposure:responsivity so that the product is 1, and use a camera of your own for another
    exposure."""
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


@rule(Severity.ERROR)
def camera_lens(scene: AssetStage) -> Iterator[Fault]:
    """Focal length, apertures and offsets of the capture camera show what its recorded pinhole
    shows. Renderers use the first, usdbrdf the second: where they differ, pictures and photographs
    do not lie over each other.

    Remove the opinions on the lens, and use a camera of your own for another view."""
    metres = UsdGeom.GetStageMetersPerUnit(scene.stage)
    for prim in scene.cameras:
        for time in _times(prim, (*LENS, *_PINHOLE)):
            pinhole, size = (prim.GetAttribute(name).Get(time) for name in _PINHOLE)
            lens = [prim.GetAttribute(name).Get(time) for name in LENS]
            if pinhole is None or size is None or not all([*list(size), *pinhole[:2]]):
                yield Fault(prim, "it states no pinhole, or no size of the pictures.")
                break
            expected = lens_from_pinhole(pinhole, size, metres)
            same = None not in lens and lens[1] and expected[1]
            if same:
                # Lengths mean nothing by themselves: only in widths of the aperture.
                ratios = np.array(lens, float) / lens[1] - np.array(expected, float) / expected[1]
                same = np.abs(ratios).max() < _TOLERANCE
            if not same:
                yield Fault(
                    prim,
                    f"focal length and apertures at time {time} are not those of "
                    "usdBrdf:capture:pinhole.",
                )
                break


def _times(prim: Usd.Prim, names: Sequence[str]) -> list[Usd.TimeCode]:
    """Those of all samples of some attributes, and the default."""
    attributes = [prim.GetAttribute(name) for name in names]
    samples = {time for attribute in attributes if attribute for time in attribute.GetTimeSamples()}
    return [Usd.TimeCode.Default(), *map(Usd.TimeCode, sorted(samples))]


@rule(Severity.ERROR)
def texture_coordinates(scene: AssetStage) -> Iterator[Fault]:
    """Objects with maps have primvars:st, one value per corner, from 0 to 1. Without them, or after
    a change of the mesh that did not carry them along, every texture is shown in the wrong place.

    Remove the opinions on primvars:st or on the mesh; after a change of the geometry run usdbrdf
    convert."""
    for item in scene.objects:
        if authored(item, "usdBrdf:texturing:texelSize") is None:
            continue
        st = UsdGeom.PrimvarsAPI(item).GetPrimvar("st")
        values = st.ComputeFlattened() if st and st.HasValue() else None
        if values is None or not len(values):
            yield Fault(item, "it has maps, but no texture coordinates (primvars:st).")
            continue
        uv, way = np.asarray(values, np.float64), st.GetInterpolation()
        corners = sum(UsdGeom.Mesh(item).GetFaceVertexCountsAttr().Get() or ())
        if way != UsdGeom.Tokens.faceVarying or len(values) != corners:
            problem = f"primvars:st has {len(values)} values, {way}, for {corners} corners."
            yield Fault(item, problem)
        elif not np.isfinite(uv).all():
            yield Fault(item, "primvars:st holds values that are no numbers.")
        elif uv.min() < -_UV_TOLERANCE or uv.max() > 1.0 + _UV_TOLERANCE:
            span = f"{uv.min():.4g} to {uv.max():.4g}"
            yield Fault(item, f"primvars:st goes from {span}; the maps from 0 to 1.")


@rule(Severity.ERROR)
def object_mesh(scene: AssetStage) -> Iterator[Fault]:
    """What was measured is of a mesh that the stage has, and there is one at least. A layer of the
    scan that lost its meshes opens without a word, and shows nothing.

    Take that layer from a copy of the asset, or run usdbrdf convert again with --discard."""
    # What was not loaded is not lost, and one layer alone is a part of an asset.
    loaded = scene.stage.GetLoadRules() == Usd.StageLoadRules.LoadAll()
    masked = scene.stage.GetPopulationMask() != Usd.StagePopulationMask.All()
    if scene.asset_root is None or scene.missing_layers or masked or not loaded:
        return
    every = list(Usd.PrimRange.Stage(scene.stage, Usd.PrimAllPrimsPredicate))
    records = [p for p in every if any(authored(p, name) is not None for name in _MEASURED)]
    lost = [prim for prim in records if not prim.IsDefined()]
    for prim in lost:
        yield Fault(prim, "there are records of a measurement of it, and no mesh.")
    # An artist may set any of them aside: beneath what is not active, or an instance, is nothing.
    aside = any(not prim.IsActive() or prim.IsInstance() for prim in every)
    if not lost and scene.root_prim and not scene.objects and not aside:
        yield Fault(scene.root_prim, "the asset has no objects.")


@rule(Severity.ERROR)
def fit_range(scene: AssetStage) -> Iterator[Fault]:
    """phi and psi lie between 0 and 1, and their errors are finite and not negative. Other values
    have no meaning in the model of the lobe.

    Remove the opinion that is stronger than the measurement's, or run usdbrdf fit."""
    return _out_of_range(scene, lambda fact: fact.schema == FIT)


@rule(Severity.WARNING)
def record_range(scene: AssetStage) -> Iterator[Fault]:
    """What else the layers record of a measurement lies in the range that makes sense: shares
    between 0 and 1, sizes, errors and radiances finite and not negative.

    Remove the opinion that is stronger than the measurement's, or run usdbrdf convert again."""
    return _out_of_range(scene, lambda fact: fact.schema != FIT and not _is_albedo(fact))


def _is_albedo(fact: Fact) -> bool:
    return fact.schema == SHADING and fact.name == "meanAlbedo"


def _out_of_range(scene: AssetStage, about: Callable[[Fact], bool]) -> Iterator[Fault]:
    """Numbers that make no sense, among the facts that ``about`` chooses."""
    for attribute, fact, _ in _authored_facts(scene.recorded):
        value = attribute.Get()
        if fact is None or not fact.is_bounded or not about(fact) or value is None:
            continue
        numbers = [value] if isinstance(value, (int, float)) else list(value)
        if not all(math.isfinite(x) and fact.low <= x <= fact.high for x in numbers):
            shown, limits = ", ".join(f"{x:g}" for x in numbers), f"{fact.low:g} to {fact.high:g}"
            yield Fault(attribute, f"the value is {shown}, outside {limits}.")


def _authored_facts(prims: Sequence[Usd.Prim]) -> Iterator[tuple[Usd.Attribute, Fact | None, str]]:
    """The attributes of prims in our namespace, each with its row of the table, or None; and with
    the instance, "" unless its schema is applied several times."""
    ours = (prim.GetAuthoredPropertiesInNamespace("usdBrdf") for prim in prims)
    for found in chain.from_iterable(ours):
        if isinstance(found, Usd.Attribute) and found.HasAuthoredValue():
            name = found.GetName()
            # usdBrdf:aov:INSTANCE:file
            parts = name.split(":")
            general = ":".join([*parts[:2], INSTANCE, *parts[3:]])
            instance = parts[2] if name not in FACTS and general in FACTS else ""
            yield found, FACTS.get(general if instance else name, _OLDER.get(name)), instance


_STATED = {
    "measured": ["phi", "psi", "phiError"],
    "bounded": ["phi", "psi", "psiUpper95"],
    "undetermined": ["phi", "psi"],
}


@rule(Severity.ERROR)
def fit_status(scene: AssetStage) -> Iterator[Fault]:
    """An object whose status is measured states phi, psi, their errors and how far the photographs
    determine them; one whose status is bounded states phi, psi and psiUpper95, one whose status is
    undetermined phi and psi. A number without its error must
    not pass for a measurement.

    Run usdbrdf fit again; do not change the status by hand."""
    for prim in scene.recorded:
        status = authored(prim, "usdBrdf:fit:status")
        wanted = _STATED.get(FACTS["usdBrdf:fit:status"].read(status), [])
        if status == "measured" and authored(prim, "usdBrdf:fit:method") == "views":
            wanted = [*wanted, "psiError"]  # a single frame does not tell it
        missing = [name for name in wanted if authored(prim, f"usdBrdf:fit:{name}") is None]
        for name in ("phiConfidence", "psiConfidence") if status == "measured" else ():
            if authored(prim, f"usdBrdf:fit:{name}") in (None, "none"):
                missing.append(name)
        if missing:
            problem = f"the status is {status}, but there is no {', '.join(missing)}."
            yield Fault(prim.GetAttribute("usdBrdf:fit:status"), problem)


@rule(Severity.ERROR)
def allowed_tokens(scene: AssetStage) -> Iterator[Fault]:
    """Attributes with a fixed vocabulary, such as usdBrdf:fit:status, hold one of its words. USD
    itself does not check that.

    Use one of the words that the message lists."""
    for attribute, fact, _ in _authored_facts(scene.recorded):
        value = attribute.Get()
        if fact and fact.tokens and fact.read(value) not in fact.tokens:
            yield Fault(attribute, f"{value!r} is none of {', '.join(fact.tokens)}.")


@rule(Severity.WARNING)
def undeclared_attribute(scene: AssetStage) -> Iterator[Fault]:
    """Attributes whose names begin with usdBrdf: are declared by the schemas. One that is not is
    misspelt, or comes from another version of usdbrdf.

    Correct the name, or put values of your own into another namespace."""
    for attribute, fact, _ in _authored_facts(scene.recorded):
        if fact is None:
            problem = "no usdBrdf schema declares an attribute of this name: nothing reads it."
            yield Fault(attribute, problem)


@cure("apply the missing schemas")
def apply(site: Site) -> bool:
    done = [site.AddAppliedSchema(name) for name in _missing_schemas(site)]
    return all(done)


@rule(Severity.WARNING, apply)
def schema_not_applied(scene: AssetStage) -> Iterator[Fault]:
    """A prim with attributes of a usdBrdf schema has that schema applied. Some tools lose applied
    schemas while they copy attributes; applications then show the values without documentation, and
    find no objects by their schema.

    Apply the schema to the prim."""
    for prim in scene.recorded:
        for name in _missing_schemas(prim):
            yield Fault(prim, f"it has attributes of {name}, but that schema is not applied to it.")


def _missing_schemas(prim: Usd.Prim) -> list[str]:
    """Schemas, as they would be applied, of the prim's attributes that are not."""
    # As authored: GetAppliedSchemas leaves out those that USD does not know.
    listed = prim.GetMetadata("apiSchemas")
    applied = listed.GetAddedOrExplicitItems() if listed else []
    facts = _authored_facts([prim])
    wanted = {fact.schema.applied(instance) for _, fact, instance in facts if fact}
    return sorted(wanted.difference(applied))


@rule(Severity.ERROR)
def object_identifier(scene: AssetStage) -> Iterator[Fault]:
    """Every object has an identifier of its own, which names its material and its textures. A
    copied object that keeps the identifier shares both with the original, and what is measured of
    one overwrites the other.

    Author another usdBrdf:identifier on the copy, or remove usdBrdf:label from it: it is then no
    object of the capture."""
    first: dict[str, Usd.Prim] = {}
    for item in scene.objects:
        identifier = str(authored(item, "usdBrdf:identifier") or "")
        if not Sdf.Path.IsValidIdentifier(identifier):
            yield Fault(item, f"usdBrdf:identifier is {identifier!r}, which names no material.")
        elif identifier in first:
            other = first[identifier].GetPath()
            yield Fault(item, f"<{other}> has the identifier {identifier} too.")
        first.setdefault(identifier, item)


@rule(Severity.WARNING)
def albedo_range(scene: AssetStage) -> Iterator[Fault]:
    """The mean albedo of an object lies between 0 and 1. More means that light was missed: a lamp
    that no photograph shows, or photographs that are not radiometric.

    Look at the irradiance map of the object and at the lamps; see the options of usdbrdf shade."""
    return _out_of_range(scene, _is_albedo)
