"""Callbacks: evaluation by team episodes, entropy schedule, checks for NaN and infinity, game steps in the logs."""
