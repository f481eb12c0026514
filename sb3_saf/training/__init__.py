"""
From settings to a trained model: named settings, training, tuning, playing, figures, and their command lines.

Combines games (``hecogrid_envs``), learning (``sb3_saf``) and hyperparameters (``zoo_configs``). ``import sb3_saf``
does not import this package.
"""
