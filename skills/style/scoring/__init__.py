"""Scoring a demonstration: beside a reference, and by a model of skill that a laboratory calibrates on data of its own.

figures     what is told of a motion, with its unit, beside the reference's
deviation   how far it lies from the reference, and where along the way
model       a rating and a level of skill as plain sums of some of the figures
calibrating the model, fitted and judged on surgeons that it has not seen
"""
