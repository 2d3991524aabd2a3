"""The command line for tests: called in this process, or in one of its own as a shell would start it."""

import io
import re
import subprocess
import sys
from types import ModuleType

from typer.testing import CliRunner

from survey.commands.verbs import app


def bathynerf(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


class Terminal(io.StringIO):
    """A terminal as far as programs ask."""

    def isatty(self) -> bool:
        return True


def without_times(text: str) -> str:
    """Lines of progress without the time before each."""
    return re.sub(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ", "", text, flags=re.MULTILINE)


def fake_module(monkeypatch, name: str, **content) -> None:
    """Put a package that is not under test here out of the way."""
    module = ModuleType(name)
    vars(module).update(content)
    monkeypatch.setitem(sys.modules, name, module)


def raising(error):
    def process(*_args, **_options):
        raise error

    return process


MAIN = "import sys; from survey.commands.app import main; sys.argv[0] = 'bathynerf'; main()"


def console(*arguments, code: str = MAIN, **options) -> subprocess.CompletedProcess:
    """The command line in a process of its own, as a shell would start it."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False, **options)
