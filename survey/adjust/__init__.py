"""The water estimated from the photographs: tie points, least squares, and what the errors of poses and lens cost."""
