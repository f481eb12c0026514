"""Environments as rows for policies: vector environments, the joint observation, the monitor."""
