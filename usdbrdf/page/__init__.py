"""The page on which people see whether to believe an asset, and where they say so."""
