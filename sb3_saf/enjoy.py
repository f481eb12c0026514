"""Watch a trained team and measure its return: ``python -m sb3_saf.enjoy --help``."""

from __future__ import annotations

from sb3_saf.training.enjoy import main

if __name__ == "__main__":
    main()
