"""Photographs: their pixels, what EXIF says of them, their lens and the files that hold their poses."""
