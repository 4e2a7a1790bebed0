"""Comparison of demonstrations: distances between them, clusters, and recognition of a surgeon's style. Pure.

distances     shapes in a common frame, and dynamic time warping between all of them
differences   the axis and the part of the path in which two differ
clusters      average linkage, and positions in a plane
recognition   the surgeon of a demonstration, with a probability calibrated on sessions left out
combining     several demonstrations as one, and a demonstration at another place
"""
