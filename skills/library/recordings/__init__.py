"""Recordings, demonstrations, proposals of hand-offs, datasets, and timelines."""
