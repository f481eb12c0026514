"""QPLEX, QMIX and VDN: off-policy value factorisation (arXiv 2008.01062, 1803.11485, 1706.05296)."""
