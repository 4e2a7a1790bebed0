"""The heart, pure: numbers in, numbers out. No files, clock, environment, database or log."""
