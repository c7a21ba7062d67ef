"""Everything that reads or writes USD."""

from usdbrdf.asset import schema

schema.register()
