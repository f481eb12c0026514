"""Inspection of team policies during training, in TensorBoard."""
