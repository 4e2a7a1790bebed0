"""Scoring of a demonstration: against a reference, and by a model of skill fitted to a laboratory's own data. Pure.

features      the figures of a motion, with units, next to the reference's
deviation     the distance from the reference, and where along the path
trials        the figures of a whole trial of two instruments and two masters
calibration   a rating as a plain sum of these, of all tasks together, and its predictions for surgeons left out
validation    the evidence that it is better than chance and than the duration; without it nothing is rated
rating        the rating of a trial, with its interval and what it comes from
"""
