"""A run: its stages, its folder, and what is read back from it."""
