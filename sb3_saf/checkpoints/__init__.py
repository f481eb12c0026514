"""
Exact resume: a run that is killed and resumed ends with the same weights as an uninterrupted run, bit for bit.

A checkpoint holds the state at the start of a rollout, between updates. It is plain data: the caller makes model,
environment and callbacks as for the first start, which are compared with a description in the checkpoint, and the
state is loaded into them.
"""
