"""Programs that measure speed, each against its baselines in one run."""
