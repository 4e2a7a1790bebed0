"""Scoring of a demonstration: against a reference, and by a model of skill fitted to a laboratory's own data. Pure.

features      the figures of a motion, with units, next to the reference's
deviation     the distance from the reference, and where along the path
calibration   a rating and a level as plain sums of some figures, judged on surgeons left out
"""
