"""``python -m usdbrdf`` is the command ``usdbrdf``."""

import sys

from usdbrdf.cli import main

sys.exit(main())
