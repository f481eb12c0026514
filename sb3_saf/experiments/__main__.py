"""``python -m sb3_saf.experiments``."""

from __future__ import annotations

import sys

from sb3_saf.experiments.cli import main

if __name__ == "__main__":
    sys.exit(main())
