"""MAPPO: a joint critic."""
