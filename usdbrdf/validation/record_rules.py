"""Rules about what the layers state of a measurement, made from the rows of ``asset.properties``:
ranges, words, and that every attribute is one of ours; and what several of them say together."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from pxr import Sdf, Usd

from usdbrdf.asset.properties import FIT, INSTANCE, SHADING, Fact, facts_by_attribute
from usdbrdf.asset.readers.scene import authored
from usdbrdf.validation.asset_stage import AssetStage
from usdbrdf.validation.rule import Fault, Severity, Site, cure, rule

# The table, by the attributes' names.
FACTS = facts_by_attribute()


class AuthoredFact(NamedTuple):
    """An authored attribute of ours; ``fact`` is None for one that the table does not have, and
    ``instance`` "" unless its schema is applied several times."""

    attribute: Usd.Attribute
    fact: Fact | None
    instance: str


@rule(
    Severity.ERROR,
    advice="Remove the opinion that is stronger than the measurement's, or run usdbrdf fit.",
)
def fit_range(scene: AssetStage) -> Iterator[Fault]:
    """phi and psi lie between 0 and 1, and their errors are finite and not negative. Other values
    have no meaning in the model of the lobe."""
    return out_of_range(scene, lambda fact: fact.schema == FIT)


@rule(
    Severity.WARNING,
    advice="Remove the opinion that is stronger than the measurement's, or run usdbrdf convert "
    "again.",
)
def record_range(scene: AssetStage) -> Iterator[Fault]:
    """What else the layers record of a measurement lies in the range that makes sense: shares
    between 0 and 1, sizes, errors and radiances finite and not negative."""
    return out_of_range(scene, lambda fact: fact.schema != FIT and not _is_albedo(fact))


@rule(
    Severity.WARNING,
    advice="Look at the irradiance map of the object and at the lamps; see the options of usdbrdf "
    "shade.",
)
def albedo_range(scene: AssetStage) -> Iterator[Fault]:
    """The mean albedo of an object lies between 0 and 1. More means that light was missed: a lamp
    that no photograph shows, or photographs that are not radiometric."""
    return out_of_range(scene, _is_albedo)


def _is_albedo(fact: Fact) -> bool:
    return fact.schema == SHADING and fact.name == "meanAlbedo"


def out_of_range(
    scene: AssetStage, about: Callable[[Fact], bool], facts: Mapping[str, Fact] = FACTS
) -> Iterator[Fault]:
    """Numbers that make no sense, among the facts that ``about`` chooses."""
    for attribute, fact, _ in _authored_facts(scene, facts):
        value = attribute.Get()
        if fact is None or not fact.is_bounded or not about(fact) or value is None:
            continue
        numbers = [value] if isinstance(value, (int, float)) else list(value)
        if not all(math.isfinite(x) and fact.low <= x <= fact.high for x in numbers):
            shown, limits = ", ".join(f"{x:g}" for x in numbers), f"{fact.low:g} to {fact.high:g}"
            yield Fault(attribute, f"the value is {shown}, outside {limits}.")


def _authored_facts(scene: AssetStage, facts: Mapping[str, Fact]) -> Iterator[AuthoredFact]:
    return (said for prim in scene.recorded for said in _facts_of_prim(prim, facts))


def _facts_of_prim(prim: Usd.Prim, facts: Mapping[str, Fact]) -> Iterator[AuthoredFact]:
    """The attributes of a prim in our namespace, each with its row of the table."""
    for attribute in prim.GetAuthoredPropertiesInNamespace("usdBrdf"):
        if isinstance(attribute, Usd.Attribute) and attribute.HasAuthoredValue():
            name = attribute.GetName()
            # usdBrdf:aov:INSTANCE:file
            parts = name.split(":")
            general = ":".join([*parts[:2], INSTANCE, *parts[3:]])
            instance = parts[2] if name not in facts and general in facts else ""
            yield AuthoredFact(attribute, facts.get(general if instance else name), instance)


@rule(Severity.ERROR, advice="Run usdbrdf fit again; do not change the status by hand.")
def fit_status(scene: AssetStage) -> Iterator[Fault]:
    """An object whose status is measured states phi, psi, their errors and how far the photographs
    determine them; one whose status is prior states phi and psi. A number without its error must
    not pass for a measurement."""
    for prim in scene.recorded:
        status = authored(prim, "usdBrdf:fit:status")
        wanted = {"measured": ["phi", "psi", "phiError"], "prior": ["phi", "psi"]}.get(status, [])
        if status == "measured" and authored(prim, "usdBrdf:fit:method") == "views":
            wanted = [*wanted, "psiError"]  # a single frame does not tell it
        missing = [name for name in wanted if authored(prim, f"usdBrdf:fit:{name}") is None]
        if status == "measured":
            names = ("phiConfidence", "psiConfidence")
            sure = {name: authored(prim, f"usdBrdf:fit:{name}") for name in names}
            missing += [name for name, value in sure.items() if value in (None, "none")]
        if missing:
            yield Fault(
                prim.GetAttribute("usdBrdf:fit:status"),
                f"the status is {status}, but there is no {', '.join(missing)}.",
            )


@rule(Severity.ERROR, advice="Use one of the words that the message lists.")
def allowed_tokens(scene: AssetStage) -> Iterator[Fault]:
    """Attributes with a fixed vocabulary, such as usdBrdf:fit:status, hold one of its words. USD
    itself does not check that."""
    return not_allowed(scene)


def not_allowed(scene: AssetStage, facts: Mapping[str, Fact] = FACTS) -> Iterator[Fault]:
    """Words that are none of a fixed vocabulary."""
    for attribute, fact, _ in _authored_facts(scene, facts):
        value = attribute.Get()
        if fact and fact.tokens and value not in fact.tokens:
            message = f"{value!r} is none of {', '.join(fact.tokens)}."
            yield Fault(attribute, message)


@rule(
    Severity.WARNING, advice="Correct the name, or put values of your own into another namespace."
)
def undeclared_attribute(scene: AssetStage) -> Iterator[Fault]:
    """Attributes whose names begin with usdBrdf: are declared by the schemas. One that is not is
    misspelt, or comes from another version of usdbrdf."""
    return undeclared(scene)


def undeclared(scene: AssetStage, facts: Mapping[str, Fact] = FACTS) -> Iterator[Fault]:
    """Attributes in our namespace that are not ours."""
    for attribute, fact, _ in _authored_facts(scene, facts):
        if fact is None:
            message = "no usdBrdf schema declares an attribute of this name: nothing reads it."
            yield Fault(attribute, message)


@cure("apply the missing schemas")
def apply(site: Site) -> bool:
    done = [site.AddAppliedSchema(name) for name in _missing_schemas(site)]
    return all(done)


@rule(Severity.WARNING, advice="Apply the schema to the prim.", cure=apply)
def schema_not_applied(scene: AssetStage) -> Iterator[Fault]:
    """A prim with attributes of a usdBrdf schema has that schema applied. Some tools lose applied
    schemas while they copy attributes; applications then show the values without documentation, and
    find no objects by their schema."""
    for prim in scene.recorded:
        for name in _missing_schemas(prim):
            yield Fault(prim, f"it has attributes of {name}, but that schema is not applied to it.")


def _missing_schemas(prim: Usd.Prim) -> list[str]:
    """Schemas, as they would be applied, of the prim's attributes that are not."""
    # As authored: GetAppliedSchemas leaves out those that USD does not know.
    listed = prim.GetMetadata("apiSchemas")
    applied = listed.GetAddedOrExplicitItems() if listed else []
    wanted = {
        fact.schema.applied(instance) for _, fact, instance in _facts_of_prim(prim, FACTS) if fact
    }
    return sorted(wanted.difference(applied))


@rule(
    Severity.ERROR,
    advice="Author another usdBrdf:identifier on the copy, or remove usdBrdf:label from it: it is "
    "then no object of the capture.",
)
def object_identifier(scene: AssetStage) -> Iterator[Fault]:
    """Every object has an identifier of its own, which names its material and its textures. A
    copied object that keeps the identifier shares both with the original, and what is measured of
    one overwrites the other."""
    first: dict[str, Usd.Prim] = {}
    for item in scene.objects:
        identifier = str(authored(item, "usdBrdf:identifier") or "")
        if not Sdf.Path.IsValidIdentifier(identifier):
            yield Fault(item, f"usdBrdf:identifier is {identifier!r}, which names no material.")
        elif identifier in first:
            yield Fault(
                item, f"<{first[identifier].GetPath()}> has the identifier {identifier} too."
            )
        first.setdefault(identifier, item)


RULES = (
    fit_range,
    record_range,
    fit_status,
    allowed_tokens,
    undeclared_attribute,
    schema_not_applied,
    object_identifier,
    albedo_range,
)
