"""Marks of control points and clicks on the waterline, set in the photographs in a browser."""
