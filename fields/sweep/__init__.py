"""The refractive plane sweep: a height per pixel of every matched view, and the points on which views agree."""
