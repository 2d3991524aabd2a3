"""Photographs: pixels, EXIF, lens, and the files of their poses."""
