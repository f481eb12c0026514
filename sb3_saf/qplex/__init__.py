"""QPLEX, QMIX and VDN: value factorisation, off-policy (arXiv 2008.01062, 1803.11485, 1706.05296)."""
