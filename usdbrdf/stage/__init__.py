"""Everything that reads or writes USD; the only package that imports pxr."""

from usdbrdf.stage import schema

schema.register()
