"""Ground floor: rows and vector environments of teams, checks, errors, files and random numbers for all rooms."""
