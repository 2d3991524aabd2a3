"""What the heads of photographs say that a user should know: rotated, of several pages, of more than 8 bits."""

from __future__ import annotations

from collections.abc import Mapping

from survey.photos.exif import Exif


def head_doubts(heads: Mapping[str, Exif]) -> list[str]:
    """Warnings about photographs that are not used as another program may show them."""
    num = len(heads)
    rotated = sum(head.orientation != 1 for head in heads.values())
    paged = sum(head.has_pages for head in heads.values())
    warnings = []
    if rotated:
        warnings.append(
            f"EXIF marks {rotated} of {num} images as rotated; pixels are used as stored and poses are assumed to "
            "refer to them"
        )
    if paged:
        warnings.append(
            f"{paged} of {num} images have several pages, of which the first is used; if they are bands or other "
            "photographs, split them"
        )
    return warnings
