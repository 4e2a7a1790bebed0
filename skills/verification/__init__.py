"""Verification: the verdict on a simulated playback, and a plan's probability of success. Pure: numpy in, numpy out."""
