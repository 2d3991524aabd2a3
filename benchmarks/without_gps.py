"""Photographs without the GPS position in their EXIF; pixels stay to the bit."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import ExifTags, Image


def copy_without_gps(source: Path, target: Path) -> None:
    """Copy a JPEG file without its position."""
    raw = source.read_bytes()
    exif = Image.open(io.BytesIO(raw)).getexif()
    exif.pop(ExifTags.Base.GPSInfo, None)
    start, parts = 2, []
    while raw[start + 1] != 0xDA:
        end = start + 2 + int.from_bytes(raw[start + 2 : start + 4], "big")
        if raw[start + 4 : start + 8] != b"Exif":
            parts.append(raw[start:end])
        start = end
    data = exif.tobytes()
    data = data if data.startswith(b"Exif") else b"Exif\0\0" + data
    head = b"\xff\xd8\xff\xe1" + (len(data) + 2).to_bytes(2, "big") + data
    target.write_bytes(head + b"".join(parts) + raw[start:])
