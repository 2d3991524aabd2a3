"""Profiles of the bed along lines: bed, water, standard deviations and a reference."""
