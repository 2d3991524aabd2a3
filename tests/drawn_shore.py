"""A drawn survey of a shore under tilted water, and how near to exact its figures are."""

from survey.simulate.drawn import DrawnScene

# Rounding of float64 over 10 m of path, and the projection's 1e-9 m, at 280 px focal length and 8 m: 4e-8 px.
EXACT_PX = 1e-6
# cameras.csv rounds to 1e-6 m and 1e-9 degrees: 0.00004 px.
STORED_PX = 1e-3
# Coordinates of about 5e6 m are stored to 1e-9 m; a few roundings on the way into the local frame.
EXACT_M = 1e-8

SHORE = DrawnScene.tiny(shore=True, slope_east=-0.002, slope_north=0.004)
