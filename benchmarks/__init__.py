"""Benchmarks: each program measures its subject and its baselines in one run."""
