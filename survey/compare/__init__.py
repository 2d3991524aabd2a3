"""A cloud against a reference, in numbers and pictures; nothing is aligned."""
