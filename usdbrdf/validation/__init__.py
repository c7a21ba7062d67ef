"""What can be wrong with an asset: rules of our own beside those of USD, and cures."""
