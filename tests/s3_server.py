"""A server of S3 in this process, by moto, and an empty bucket in it."""

from collections.abc import Iterator
from contextlib import contextmanager
from uuid import uuid4

import pytest


@contextmanager
def served(monkeypatch) -> Iterator[str]:
    """URL of the bucket, whose server the environment names; skip where a library is missing."""
    pytest.importorskip("s3fs", reason="s3fs, of the extra `remote`, is not installed")
    server = pytest.importorskip("moto.server", reason="moto[s3], flask and flask-cors are not installed")
    import logging

    import fsspec

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    running = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    host, port = running.get_host_and_port()
    names = {"AWS_ACCESS_KEY_ID": "a", "AWS_SECRET_ACCESS_KEY": "b", "AWS_DEFAULT_REGION": "us-east-1"}
    for name, value in (names | {"AWS_ENDPOINT_URL": f"http://{host}:{port}"}).items():
        monkeypatch.setenv(name, value)
    s3 = fsspec.filesystem("s3", skip_instance_cache=True)
    try:
        # What the server holds is that of the process.
        bucket = f"survey-{uuid4().hex[:8]}"
        s3.mkdir(bucket)
        s3.clear_instance_cache()
        yield f"s3://{bucket}"
    finally:
        s3.clear_instance_cache()
        running.stop()
