"""Neural networks: encoders, actors, critics, the knowledge source, the policy pool."""
