"""Words that several warnings share."""

from __future__ import annotations


def named(names: list[str], noun: str, what: str) -> list[str]:
    """A warning that counts and names, e.g. "2 images without a pose, left out: a.jpg, b.jpg"; none without names."""
    if not names:
        return []
    more = f" and {len(names) - 10} more" if len(names) > 10 else ""
    plural = "s" if len(names) > 1 else ""
    return [f"{len(names)} {noun}{plural} {what}: {', '.join(names[:10])}{more}"]
