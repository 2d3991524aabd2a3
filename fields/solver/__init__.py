"""A least-squares solver for the bed: all photographs at once along bent rays, about the heights of the sweep."""
