"""Material bindings of an input file that could win against those of our looks.

The looks bind the mesh for all purposes, inside variants. That beats the input's own binding of the
mesh, which arrives by a reference. It does not beat a binding for one purpose, of a collection, of
a face subset, or of an ancestor that claims to be stronger. The last kind is told to give way, in
the scan layer; the others are listed there, and every look binds them as well.
"""

from __future__ import annotations

from collections.abc import Mapping

from pxr import Sdf, Usd, UsdGeom, UsdShade

from usdbrdf.asset.header import read_provenance
from usdbrdf.asset.layers.author import over, relationship
from usdbrdf.asset.layout import Asset

BINDING = "material:binding"

# Relationships to bind besides the mesh's own: path -> the collection it is about, or "".
Competing = Mapping[str, str]


def competing_bindings(mesh: Usd.Prim, source: Usd.Prim, root: str) -> dict[str, str]:
    """For one mesh of the input; paths below ``source``, its default prim, become ours."""
    purposes = {
        purpose
        for prim in _with_ancestors(mesh, source)
        for binding in _bindings(prim)
        if (purpose := _purpose(binding)) != ""
    }
    found = {f"{mesh.GetPath()}.{BINDING}:{purpose}": "" for purpose in sorted(purposes)}
    subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Mesh(mesh))
    for prim in (mesh, *(subset.GetPrim() for subset in subsets)):
        for binding in _bindings(prim):
            if binding.GetPath() != mesh.GetPath().AppendProperty(BINDING):
                collections = [t for t in binding.GetTargets() if t.IsPropertyPath()]
                found[str(binding.GetPath())] = str(collections[0]) if collections else ""
    here = Sdf.Path(root)

    def ours(path: str) -> str:
        return str(Sdf.Path(path).ReplacePrefix(source.GetPath(), here)) if path else ""

    return {ours(path): ours(collection) for path, collection in found.items()}


def weaken_bindings(layer: Sdf.Layer, mesh: Usd.Prim, source: Usd.Prim, root: str) -> None:
    """Take back what ancestors of the mesh say about being stronger than it."""
    for prim in _with_ancestors(mesh, source):
        for binding in _bindings(prim) if prim != mesh else []:
            strength = binding.GetMetadata("bindMaterialAs")
            if strength == UsdShade.Tokens.strongerThanDescendants:
                path = prim.GetPath().ReplacePrefix(source.GetPath(), Sdf.Path(root))
                weaker = relationship(over(layer, str(path)), binding.GetName())
                weaker.SetInfo("bindMaterialAs", UsdShade.Tokens.weakerThanDescendants)


def recorded_bindings(asset: Asset) -> dict[str, Competing]:
    """What the scan layer lists, per object's prim path; empty where the geometry is ours."""
    layer = asset.layer("scan")
    recorded = read_provenance(layer).get("competing_bindings", {}) if layer.is_file() else {}
    return {prim_path: dict(found) for prim_path, found in recorded.items()}


def _with_ancestors(mesh: Usd.Prim, source: Usd.Prim) -> list[Usd.Prim]:
    stage = mesh.GetStage()
    prefixes = mesh.GetPath().GetPrefixes()
    return [stage.GetPrimAtPath(p) for p in prefixes if p.HasPrefix(source.GetPath())]


def _bindings(prim: Usd.Prim) -> list[Usd.Relationship]:
    return [
        p
        for p in prim.GetAuthoredProperties()
        if isinstance(p, Usd.Relationship) and f"{p.GetName()}:".startswith(f"{BINDING}:")
    ]


def _purpose(binding: Usd.Relationship) -> str:
    """ "" for all purposes. Names are BINDING[:purpose] or BINDING:collection[:purpose]:name."""
    parts = binding.GetName().split(":")[2:]
    if parts[:1] == ["collection"]:
        return parts[1] if len(parts) > 2 else ""
    return parts[0] if parts else ""
