"""Train or tune a team by name: ``python -m sb3_saf.train --help``."""

from __future__ import annotations

from sb3_saf.training.train import main

if __name__ == "__main__":
    main()
