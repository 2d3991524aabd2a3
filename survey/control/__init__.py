"""Points of known coordinates: control points with their marks in photographs, and check points, from their files."""
