"""EXIF of a PNG, wherever in the file it stands: Pillow would decode all pixels to look behind them."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

_SIGNATURE_BYTES, _CHECKSUM_BYTES = 8, 4
# EXIF of photographs has some kilobytes, with a preview some hundred.
_LONGEST_EXIF = 4_000_000


def exif_of_png(path: Path) -> Image.Exif:
    """The EXIF of a PNG file; empty where there is none.

    Raises
    ------
    SyntaxError, ValueError
        Where it is damaged.
    """
    exif = Image.Exif()
    with path.open("rb") as file:
        file.seek(_SIGNATURE_BYTES)
        while len(head := file.read(8)) == 8:
            length, kind = int.from_bytes(head[:4], "big"), head[4:]
            if kind == b"eXIf" and length <= _LONGEST_EXIF:
                exif.load(b"Exif\0\0" + file.read(length))
                break
            file.seek(length + _CHECKSUM_BYTES, 1)
    return exif
