"""From an asset to figures and pictures: against photographs, known truth, another asset."""
