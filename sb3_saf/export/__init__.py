"""Trained actors as files: written beside the training code, run without it, loaded without unpickling."""
