"""A disk that is full, or nearly."""

import resource
import signal
from contextlib import contextmanager


@contextmanager
def file_size_limit(size: int):
    """Let no file of this process grow beyond ``size`` bytes: the nearest thing to a full disk."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        signal.signal(signal.SIGXFSZ, handler)
