"""Write a page that plays episodes of a team: ``python -m sb3_saf.replay --help``."""

from __future__ import annotations

from sb3_saf.training.replay import main

if __name__ == "__main__":
    main()
