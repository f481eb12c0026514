"""IPPO: a local critic."""
