"""Print pip's settings of this machine as environment variables of uv, a line ``export NAME=value`` each.

python scripts/uv_settings.py, by the interpreter of an environment with pip

uv reads neither pip's configuration files nor its ``PIP_*`` variables: a machine with an index, certificates or wheels
of its own would be asked for them twice. What is already set for uv is left as it is.
"""

from __future__ import annotations

import ast
import os
import shlex
import subprocess
import sys

UV_OF_PIP = {
    "index-url": "UV_DEFAULT_INDEX",
    "extra-index-url": "UV_INDEX",
    "find-links": "UV_FIND_LINKS",
    "no-index": "UV_NO_INDEX",
    "constraint": "UV_CONSTRAINT",
    "trusted-host": "UV_INSECURE_HOST",
    "timeout": "UV_HTTP_TIMEOUT",
    "default-timeout": "UV_HTTP_TIMEOUT",
    "cert": "SSL_CERT_FILE",
    "client-cert": "SSL_CLIENT_CERT",
    "proxy": "ALL_PROXY",
}
# The later wins: [global], then the section of the command, then variables.
SECTIONS = ("global", "install", ":env:")


def pip_settings(listing: str) -> dict[str, str]:
    """Values by key from what ``pip config list`` prints: a line ``section.key='value'`` each."""
    by_section: dict[str, dict[str, str]] = {section: {} for section in SECTIONS}
    for line in listing.splitlines():
        name, equals, value = line.partition("=")
        section, _, key = name.rpartition(".")
        if equals and section in by_section:
            by_section[section][key] = str(ast.literal_eval(value))
    return {key: value for section in SECTIONS for key, value in by_section[section].items()}


def uv_settings(settings: dict[str, str], *, system: str = sys.platform) -> dict[str, str]:
    """uv's environment variables for pip's settings.

    Where pip names no source of its own, Linux takes the build of torch that fits the machine: the CPU build where
    there is no CUDA device (the package index itself serves the one for CUDA alone).
    """
    # pip separates entries by white space; uv those of find-links by commas, others by a blank.
    variables = {
        UV_OF_PIP[key]: ("," if key == "find-links" else " ").join(value.split())
        for key, value in settings.items()
        if key in UV_OF_PIP
    }
    if {"UV_INDEX", "UV_DEFAULT_INDEX"} & variables.keys():
        # pip takes the best version of all sources, uv by default of the first source that has the package.
        variables["UV_INDEX_STRATEGY"] = "unsafe-best-match"
    elif not {"UV_FIND_LINKS", "UV_NO_INDEX"} & variables.keys() and system == "linux":
        variables["UV_TORCH_BACKEND"] = "auto"
    return variables


if __name__ == "__main__":
    listing = subprocess.run(
        [sys.executable, "-m", "pip", "config", "list"], capture_output=True, text=True, check=True
    ).stdout
    for variable, value in uv_settings(pip_settings(listing)).items():
        if variable not in os.environ:
            sys.stdout.write(f"export {variable}={shlex.quote(value)}\n")
