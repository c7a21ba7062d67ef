"""The codeless schemas: where they lie, how USD learns of them, and whether it did."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from pxr import Plug, Usd

from usdbrdf.errors import UsdBrdfError
from usdbrdf.files.documents import read_json

_PACKAGE = Path(__file__).resolve().parents[1]

_PLUGIN = "usdBrdf"

# Earlier versions of USD take validators from C++ alone.
_PYTHON_VALIDATORS = (0, 26, 8)

_PROBE = ("UsdBrdfMaterialFitAPI", "usdBrdf:fit:phi")


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


@cache
def schema_version() -> int:
    """Version of the schemas that this package brings: what its layers state. Rises when an
    attribute changes its meaning or goes away, not when one is added."""
    return int(_plug_info()["UsdBrdf"]["schemaVersion"])


@cache
def schema_names() -> tuple[str, ...]:
    """Names of the schemas, as they are applied."""
    return tuple(_plug_info()["Types"])


def _plug_info() -> dict[str, Any]:
    (plugin,) = read_json(plugin_path() / "plugInfo.json")["Plugins"]
    return dict(plugin["Info"])


def register() -> None:
    """Announce the schemas and the validators to USD; harmless when PXR_PLUGINPATH_NAME has done
    so already.

    Asks the schema registry nothing: the first question builds it, and what is registered
    afterwards, by us or by another package, would stay unknown.
    """
    registry = Plug.Registry()
    if not registry.GetPluginWithName(_PLUGIN):
        registry.RegisterPlugins(str(plugin_path()))
    if Usd.GetVersion() >= _PYTHON_VALIDATORS:
        registry.RegisterPlugins(str(validators_path()))


def verify() -> None:
    """Raise unless USD knows the schemas with their attributes; called before the first write.

    A plug-in that came too late, or whose resources were not found, still lists the types: only
    the attributes tell.
    """
    schema, attribute = _PROBE
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(schema)
    if not definition or attribute not in definition.GetPropertyNames():
        raise UsdBrdfError(
            "OpenUSD does not know the usdBrdf schemas: it had built its schema registry before "
            "usdbrdf was imported. Import usdbrdf before any stage is opened, or set "
            f"PXR_PLUGINPATH_NAME={plugin_path()}. [schema.unknown]"
        )
    # Another installation's, by PXR_PLUGINPATH_NAME.
    metadata = Plug.Registry().GetPluginWithName(_PLUGIN).metadata
    version = metadata.get("UsdBrdf", {}).get("schemaVersion")
    if version != schema_version():
        raise UsdBrdfError(
            f"OpenUSD knows version {version} of the usdBrdf schemas, this usdbrdf writes version "
            f"{schema_version()}. Set PXR_PLUGINPATH_NAME={plugin_path()}. [schema.version]"
        )
