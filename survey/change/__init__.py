"""Change between two surveys of a place: differences, volumes, and how well they are known."""
