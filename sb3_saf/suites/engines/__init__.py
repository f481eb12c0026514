"""Engines of suites that step all games of a VecEnv in one call. Letters: E games, N agents, B = E * N rows."""
