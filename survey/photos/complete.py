"""Whether an image file is whole: neither cut off nor with data that was lost within.

Decoders fill what is missing with grey and say nothing. Of a JPEG libjpeg's warnings tell it, of a PNG its checksums,
of an uncompressed TIFF where its strips end; other files are decoded.
"""

from __future__ import annotations

import re
from pathlib import Path

import simplejpeg

from survey.errors import ImageError
from survey.photos.pixels import damage_named, open_image, open_stream, read_rgb

_JPEG_BEGIN, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
# libjpeg makes no grey levels of these. An eighth of the size takes the least time; every block is read all the same.
_FOUR_COMPONENTS, _EIGHTH = ("CMYK", "YCCK"), 8
# libjpeg's warnings about compressed pixels; others are about headers. Cameras fill up the last word of the pixels.
_DAMAGE = re.compile(r"Corrupt JPEG data|Premature end|Inconsistent progression")
_FILL_BYTES = re.compile(r"Corrupt JPEG data: \d extraneous bytes before marker 0xd9")
_TIFF_COMPRESSION, _UNCOMPRESSED = 259, 1
# Tags of the positions and lengths of strips, and of tiles.
_TIFF_PIXELS = ((273, 279), (324, 325))


def require_complete(path: Path) -> None:
    """Raise ImageError where an image is cut off, damaged, or no image."""
    with path.open("rb") as file:
        if file.read(len(_JPEG_BEGIN)) == _JPEG_BEGIN:
            _require_complete_jpeg(path, _JPEG_BEGIN + file.read())
            return
    with open_image(path) as image:
        format_name, tags = image.format, dict(getattr(image, "tag_v2", {}))
    if format_name == "PNG":
        with damage_named(f"{path} is damaged or cut off"), path.open("rb") as file, open_stream(file, "PNG") as image:
            image.verify()
    elif format_name == "TIFF" and tags.get(_TIFF_COMPRESSION, _UNCOMPRESSED) == _UNCOMPRESSED:
        size = path.stat().st_size
        for where, length in _TIFF_PIXELS:
            starts, counts = tags.get(where, ()), tags.get(length, ())
            if isinstance(starts, tuple) and isinstance(counts, tuple) and 0 < len(starts) == len(counts):
                places = zip(starts, counts, strict=True)
                if all(isinstance(start, int) and 0 < start <= start + count <= size for start, count in places):
                    return
                break
        raise ImageError(_message(path, "its tags do not name a place within the file for all of its pixels"))
    else:
        read_rgb(path)


def _message(path: Path, damage: str) -> str:
    return f"{path} is damaged or cut off ({damage}); copy it again or remove it"


def _require_complete_jpeg(path: Path, data: bytes) -> None:
    try:
        _, _, colours, _ = simplejpeg.decode_jpeg_header(data, strict=False)
        target = "CMYK" if colours in _FOUR_COMPONENTS else "GRAY"
        # Some cameras leave out the end marker, and some add bytes behind it.
        simplejpeg.decode_jpeg(data + _JPEG_END, target, strict=True, min_height=1, min_width=1, min_factor=_EIGHTH)
    except (ValueError, KeyError) as error:  # KeyError: of a header without colours
        warning = " ".join(str(error).split())[:100]
        if _DAMAGE.match(warning) and not _FILL_BYTES.fullmatch(warning):
            raise ImageError(_message(path, warning)) from error
        # Of a kind that libjpeg-turbo's interface does not know, or of another structure.
        read_rgb(path)
