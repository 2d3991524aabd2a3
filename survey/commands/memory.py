"""Refuses an address-space limit (ulimit -v) too small for Dr.Jit, which would crash without a message."""

from __future__ import annotations

import resource

from survey.errors import SurveyError

# Address space of the smallest survey in draft quality on four cores: 3.0 GB suffice; with 2.8 GB Dr.Jit ends the
# process by a segmentation fault or an abort.
_LEAST_BYTES = 3.0e9


def address_space_shortage() -> str | None:
    """The message if the address space of this process is limited to less than the kernels need; else None."""
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit in (resource.RLIM_INFINITY, -1) or limit >= _LEAST_BYTES:
        return None
    return (
        f"the address space of this process is limited to {limit / 1e9:.1f} GB (ulimit -v), expected at least "
        f"{_LEAST_BYTES / 1e9:.0f} GB; raise the limit"
    )


def require_address_space() -> None:
    """Raise SurveyError where `address_space_shortage` has something to say."""
    shortage = address_space_shortage()
    if shortage is not None:
        raise SurveyError(shortage)
