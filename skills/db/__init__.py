"""The database: rows are labels on values."""
