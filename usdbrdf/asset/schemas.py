"""The codeless schemas: where they lie, how USD learns of them, and whether it did."""

from __future__ import annotations

from pathlib import Path

from pxr import Plug, Usd

from usdbrdf.asset.properties import FIT, SCHEMA_VERSION
from usdbrdf.errors import UsdBrdfError

_PACKAGE = Path(__file__).resolve().parents[1]
_PLUGIN = "usdBrdf"
# Earlier versions of USD take validators from C++ alone.
_PYTHON_VALIDATORS = (0, 26, 8)


def plugin_path() -> Path:
    """Folder that holds plugInfo.json: inside the installed package, or beside it in a checkout."""
    for folder in (_PACKAGE / "schemas", _PACKAGE.parent / "schemas"):
        if (folder / "plugInfo.json").is_file():
            return folder
    raise UsdBrdfError(
        f"{_PACKAGE}: the folder schemas/ with plugInfo.json is missing from this installation. "
        "Install usdbrdf again. [schema.missing]"
    )


def validators_path() -> Path:
    """Folder of the plugInfo.json that announces our validators to USD."""
    return _PACKAGE / "validation"


def register() -> None:
    """Announce the schemas and the validators to USD; harmless when PXR_PLUGINPATH_NAME has done so
    already. Asks the schema registry nothing: the first question builds it, and what is registered
    afterwards, by us or by another package, would stay unknown."""
    registry = Plug.Registry()
    if not registry.GetPluginWithName(_PLUGIN):
        registry.RegisterPlugins(str(plugin_path()))
    if Usd.GetVersion() >= _PYTHON_VALIDATORS:
        registry.RegisterPlugins(str(validators_path()))


def verify() -> None:
    """Raise unless USD knows the schemas with their attributes; called before the first write. A
    plug-in that came too late, or whose resources were not found, still lists the types: only the
    attributes tell."""
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(FIT.identifier)
    if not definition or FIT.attribute(FIT.key) not in definition.GetPropertyNames():
        raise UsdBrdfError(
            "OpenUSD does not know the usdBrdf schemas: it had built its schema registry before "
            "usdbrdf was imported. Import usdbrdf before any stage is opened, or set "
            f"PXR_PLUGINPATH_NAME={plugin_path()}. [schema.unknown]"
        )
    # Another installation's, by PXR_PLUGINPATH_NAME.
    metadata = Plug.Registry().GetPluginWithName(_PLUGIN).metadata
    version = metadata.get("UsdBrdf", {}).get("schemaVersion")
    if version != SCHEMA_VERSION:
        raise UsdBrdfError(
            f"OpenUSD knows version {version} of the usdBrdf schemas, this usdbrdf writes version "
            f"{SCHEMA_VERSION}. Set PXR_PLUGINPATH_NAME={plugin_path()}. [schema.version]"
        )
