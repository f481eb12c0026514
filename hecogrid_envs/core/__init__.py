"""Compiled kernels of the rule book: functions on arrays, no classes."""
