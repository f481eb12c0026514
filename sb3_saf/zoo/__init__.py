"""
The zoo: named settings, training and tuning on RL-Zoo3, watching, and figures.

It joins the games (``hecogrid_envs``), the learning (``sb3_saf``) and the numbers (``zoo_configs``). Importing
``sb3_saf`` does not import it; ``sb3_saf.zoo.settings`` does not import RL-Zoo3.
"""
