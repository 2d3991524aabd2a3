"""Triangles of the bed from its points: `surface` makes them, by one of two methods, and closes them where asked."""
