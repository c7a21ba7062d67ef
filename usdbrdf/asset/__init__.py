"""Everything that reads or writes USD."""

from usdbrdf.asset.properties import register

register()
