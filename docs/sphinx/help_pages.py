"""Sphinx directive `{help}`: what `bathynerf VERB --help` prints."""

import os
import subprocess
import sys
from typing import ClassVar

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from sphinx.util.typing import ExtensionMetadata


class Help(SphinxDirective):
    """The help of the verb that is the directive's argument, 80 columns wide; without one, that of `bathynerf`."""

    optional_arguments = 1
    has_content = False
    option_spec: ClassVar = {}

    def run(self) -> list[nodes.Node]:
        """Return one literal block. A verb that does not exist fails the build."""
        command = [sys.executable, "-m", "bathynerf", *self.arguments, "--help"]
        plain = {"COLUMNS": "80", "NO_COLOR": "1", "TERM": "dumb"}
        done = subprocess.run(command, capture_output=True, text=True, env=os.environ | plain)
        if done.returncode != 0:
            raise self.error(f"{' '.join(command[1:])} ended with exit code {done.returncode}: {done.stderr.strip()}")
        text = done.stdout.strip("\n")
        return [nodes.literal_block(text, text, language="text")]


def setup(app: Sphinx) -> ExtensionMetadata:
    """Register the directive."""
    app.add_directive("help", Help)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
