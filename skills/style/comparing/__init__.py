"""Comparing demonstrations: how far apart two are, where, and whose a new one is.

shapes        motions laid on each other, so that their place, and if wanted their size, say nothing
distances     dynamic time warping between all of them
measured      what of that is kept of one demonstration
clusters      which belong together
chart         places in a plane about as far apart
differences   which axis and which part of the way sets two apart
recognition   whose style it is, with a probability that was calibrated on sessions left out
"""
