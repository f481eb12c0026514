"""Policies for SB3 and sb3-contrib: the actors and critics of the algorithms as policy classes."""
