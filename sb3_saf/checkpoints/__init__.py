"""
Exact resume: a run that is killed and resumed ends with the same weights as an uninterrupted run, bit for bit.

A checkpoint holds the state at the start of a rollout, between updates. It is plain data (JSON and NumPy arrays): the
caller makes model, environment and callbacks as for the first start, and the state is loaded into them. All data are
checked before loading.
"""
