"""Programs that show how to train on environments of others."""
