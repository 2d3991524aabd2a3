"""Standard streams that are closed, full or broken do not stop a command, or stop it in one sentence."""

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import MAIN, console
from slow_cases import slow
from small_survey import small_survey

from survey.commands.faults import BAD_INPUT as BAD_INPUT_CODE
from survey.commands.faults import BROKEN_PIPE
from survey.progress import Progress


@pytest.mark.parametrize("arguments", [("--help",), ("check", "{survey}")], ids=lambda arguments: arguments[0])
def test_a_pipe_whose_reader_has_gone_ends_the_command_without_a_word(tmp_path, arguments):
    folder = small_survey(tmp_path / "s")
    reader, writer = os.pipe()
    os.close(reader)
    try:
        result = console(*(word.format(survey=folder) for word in arguments), stdout=writer)
    finally:
        os.close(writer)
    assert result.returncode == BROKEN_PIPE
    assert all(line.endswith(f"reading {folder}") for line in result.stderr.splitlines())


@pytest.mark.parametrize("arguments", [("--help",), slow(("check", "{survey}"))], ids=lambda arguments: arguments[0])
def test_a_full_device_behind_standard_output_is_said_in_one_sentence(tmp_path, arguments):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no device that is always full")
    folder = small_survey(tmp_path / "s")
    with Path("/dev/full").open("w") as full:
        result = console(*(word.format(survey=folder) for word in arguments), stdout=full)
    assert result.stderr.splitlines()[-1] == (
        "error: cannot write standard output: no space is left on the disk; free some or write elsewhere"
    )
    assert result.returncode == BAD_INPUT_CODE


@pytest.mark.parametrize("closed", [slow(">&-"), slow("2>&-"), ">&- 2>&- <&-"])
def test_closed_standard_streams_do_not_stop_a_command(tmp_path, closed):
    folder = small_survey(tmp_path / "s")
    command = ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, "-c", MAIN, "check", str(folder)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0
    assert all(" reading " in line for line in result.stderr.splitlines())
    assert ("Found" in result.stdout) == (closed == "2>&-")


class FullDevice(io.StringIO):
    def write(self, _text):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_standard_error_that_is_full_does_not_stop_a_run_nor_its_log(tmp_path):
    with Progress(stream=FullDevice(), log_path=tmp_path / "log.txt") as progress:
        progress.note("a note")
        progress.note("another")
    assert [line.split(" ", 2)[2] for line in (tmp_path / "log.txt").read_text().splitlines()] == ["a note", "another"]
