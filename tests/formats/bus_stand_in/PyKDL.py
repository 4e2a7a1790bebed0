"""A stand-in: poses are not played."""
