"""The pages' own commands."""
