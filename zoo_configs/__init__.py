"""Hyperparameters and levels, as YAML files; ``sb3_saf.training.settings`` reads them."""
