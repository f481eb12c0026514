"""
Exact resume: a run that is killed at any moment and resumed ends with the weights of the undisturbed run, bit for bit.

A checkpoint holds the state at the start of a rollout, where no update is half done and no buffer half full. It is data
(JSON and NumPy arrays): the caller makes model, environment and callbacks as for the first start, and the state is
loaded into them. Everything in it is checked before it is loaded.
"""
