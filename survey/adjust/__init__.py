"""Adjustment of a survey to its photographs: tie points, least squares, errors of poses and lens, and the water."""
