"""Refuses limits of memory (ulimit -v, ulimit -d) too small for Dr.Jit, which would crash without a message."""

from __future__ import annotations

from survey.errors import SurveyError

# Address space of the smallest survey in draft quality on four cores: 3.0 GB suffice; with 2.8 GB Dr.Jit ends the
# process by a segmentation fault or an abort.
_LEAST_BYTES = 3.0e9
# Data of the smallest survey; with 0.3 GB the same happens, with 0.2 GB already to an import.
_LEAST_DATA_BYTES = 0.4e9
_LIMITS = (
    ("AS", "address space", "ulimit -v", _LEAST_BYTES),
    ("DATA", "memory", "ulimit -d", _LEAST_DATA_BYTES),
)


def address_space_shortage() -> str | None:
    """The message if this process is limited to less address space or data than the kernels need; else None."""
    from survey import machine

    for kind, words, command, least in _LIMITS:
        limit = machine.limit_bytes(kind)
        if limit < least:
            return (
                f"the {words} of this process is limited to {limit / 1e9:.1f} GB ({command}), expected at least "
                f"{least / 1e9:.1g} GB; raise the limit"
            )
    return None


def require_address_space() -> None:
    """Raise SurveyError where `address_space_shortage` has something to say."""
    shortage = address_space_shortage()
    if shortage is not None:
        raise SurveyError(shortage)
