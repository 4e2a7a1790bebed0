"""Demonstrations: recordings as values, the hand-off segments in them, and their quality. Pure: numpy in, numpy out."""
