"""What the algorithms share: teams of rows, distinct-row encoding, buffers, monitors, evaluation, networks."""
