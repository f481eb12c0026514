"""Draw the runs in a log folder: ``python -m sb3_saf.plot --help``."""

from __future__ import annotations

from sb3_saf.training.plot import main

if __name__ == "__main__":
    main()
