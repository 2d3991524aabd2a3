"""A run in a browser: its cloud by level of detail, its water, its photographs, and what a click asks of them."""
