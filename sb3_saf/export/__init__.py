"""Export of trained actors to files that run without the training code and load without unpickling."""
