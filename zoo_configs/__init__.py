"""Hyperparameters and levels, as YAML files; ``sb3_saf.zoo.settings`` reads them."""
