"""The documentation, and the commands that make its figures and check its links."""
