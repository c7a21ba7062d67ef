"""``python -m usdbrdf`` is the command ``usdbrdf``."""

from __future__ import annotations

import sys

from usdbrdf.cli import main

sys.exit(main())
