"""Whether a request to a server may be answered: decided here for all servers of bathynerf.

Browsers send requests to this machine for any page, and any user of the machine can send one.
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from email.message import Message
from urllib.parse import urlsplit

_LOOPBACK = ("localhost", "127.0.0.1", "::1")


def is_own_page(headers: Mapping[str, str] | Message, host: str, given: str, token: str) -> bool:
    """Whether a request to a server at a host has its token, and comes from a page of it, or from no page.

    A server on a loopback address only answers requests to loopback names, against DNS rebinding.
    """
    named, origin = headers.get("Host") or "", headers.get("Origin")
    is_here = host not in _LOOPBACK or urlsplit(f"//{named}").hostname in _LOOPBACK
    is_own = origin is None or origin in (f"http://{named}", f"https://{named}")
    return secrets.compare_digest(given.encode(), token.encode()) and is_here and is_own
