"""
Exact resume: a run that is killed at any moment and resumed ends with the weights of the undisturbed run, bit for bit.

Checkpoints hold the state at the start of a rollout, where no half-done update or half-full buffer exists. They are
data (safetensors with JSON): the caller makes model, environment and callbacks as for the first start, and the state is
loaded into them, so nothing is unpickled.
"""
