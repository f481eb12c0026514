"""Looking into team policies while they train, on TensorBoard's page."""
