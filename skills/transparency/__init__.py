"""Merkle trees over log entries, their signed heads, and signed statements about files."""
