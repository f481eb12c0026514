"""Rollouts and replays of whole teams."""
