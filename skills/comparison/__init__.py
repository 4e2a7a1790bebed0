"""Comparison of demonstrations: distances between them, clusters, and recognition of a surgeon's style. Pure.

distances     shapes in a common frame, and dynamic time warping between all of them
differences   the axis and the part of the path in which two differ
clusters      average linkage, and positions in a plane
nearest       the nearest shapes among many, exactly, without measuring all
traits        a motion as numbers: shape, tempo, jaw, turning, orientation, place
recognition   the surgeon of a demonstration, with a probability calibrated on sessions left out, or none of these
combining     several demonstrations as one, and a demonstration at another place
"""
