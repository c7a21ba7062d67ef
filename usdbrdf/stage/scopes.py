"""Where our prims live below the default prim, without ever meeting an input file's own."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass, fields

from usdbrdf.stage.asset import Asset
from usdbrdf.stage.header import read_provenance


@dataclass(frozen=True, kw_only=True)
class Scopes:
    """Names of the scopes that hold our prims; ``root`` is the default prim's path.

    If the geometry came as USD, its default prim may have children of these names already (``mtl``
    is the usual one): ours then begin with ``usdbrdf_``, since prims of one path would merge.
    """

    root: str
    geometry: str = "geo"
    materials: str = "mtl"
    looks: str = "looks"
    cameras: str = "cameras"
    lights: str = "lights"
    render: str = "render"

    @staticmethod
    def beside(root: str, taken: Collection[str]) -> Scopes:
        """Scopes whose names are not among ``taken``, the children of an input's default prim."""
        names = {f.name: str(f.default) for f in fields(Scopes) if f.name != "root"}
        for field_name, name in names.items():
            while name in taken:
                name = f"usdbrdf_{name}"
            names[field_name] = name
        return Scopes(root=root, **names)

    @staticmethod
    def of(asset: Asset) -> Scopes:
        """The scopes that the asset's scan layer recorded; the usual ones before it exists."""
        root = f"/{asset.name}"
        layer = asset.layer("scan")
        recorded = read_provenance(layer).get("scopes", {}) if layer.is_file() else {}
        # Versions that knew no lights did not look whether the input has some of that name.
        names = {"lights": "usdbrdf_lights", **recorded} if recorded else {}
        return Scopes(root=root, **{name: str(value) for name, value in names.items()})

    def names(self) -> dict[str, str]:
        """What the scan layer records."""
        return {name: value for name, value in asdict(self).items() if name != "root"}

    def path(self, scope: str, *names: str) -> str:
        """Path of a prim in a scope: ``path("materials", "chair")`` is /NAME/mtl/chair."""
        return "/".join((self.root, getattr(self, scope), *names))
