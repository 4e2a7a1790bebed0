"""The atlas, nearest neighbours, recognition, scores, and calibrations of skill."""
