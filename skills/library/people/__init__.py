"""Surgeons, suture types, consent, keys, and the erasure of a surgeon's data."""
