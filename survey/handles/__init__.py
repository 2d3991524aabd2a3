"""A survey and its runs as objects, for programs and notebooks."""
