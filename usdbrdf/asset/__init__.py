"""Everything that reads or writes USD."""

from usdbrdf.asset.schemas import register

register()
