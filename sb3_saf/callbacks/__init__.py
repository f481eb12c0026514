"""Callbacks: evaluation by team episodes, checks for NaN and infinity, game steps in the logs."""
