"""Limits of what files and settings may hold."""

# No coordinate, time or number of a survey is larger; squares of larger ones overflow.
LARGEST = 1e12
