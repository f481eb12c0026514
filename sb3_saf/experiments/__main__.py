"""``python -m sb3_saf.experiments``."""

from __future__ import annotations

import sys

from sb3_saf.experiments.cli import main

# Worker processes import this module again, under another name.
if __name__ == "__main__":
    sys.exit(main())
