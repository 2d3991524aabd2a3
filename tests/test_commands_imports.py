"""What a command imports: nothing slow before it is needed, and one sentence where it is stopped meanwhile."""

import os
import re
import subprocess
import sys

import pytest
from command_line import MAIN, console
from small_survey import small_survey

from survey.commands.faults import STOPPED


def test_help_version_and_errors_come_before_anything_slow_is_imported(tmp_path):
    folder = small_survey(tmp_path / "s")
    code = (
        "import sys; from survey.commands.app import main; sys.argv = ['bathynerf', *sys.argv[1:]]\n"
        "try: main()\n"
        "finally: print(sorted({'torch', 'matplotlib', 'scipy', 'pycolmap', 'cv2', 'drjit'} & set(sys.modules)))"
    )

    def run(*arguments):
        command = [sys.executable, "-c", code, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    shown = run("--version")
    assert shown.returncode == 0
    assert re.match(r"bathynerf \d+\.\d+", shown.stdout)
    assert shown.stdout.endswith("[]\n")
    assert "compare" in run("--help").stdout
    # check needs images (cv2), asks for the device (drjit) and foresees (scipy); neither torch nor a reconstruction.
    checked = run("check", folder)
    assert checked.returncode == 0
    assert checked.stdout.splitlines()[-1] == "['cv2', 'drjit', 'scipy']"


def test_help_brings_no_library_of_numbers_or_files():
    slow = "{'numpy', 'pyproj', 'rasterio', 'laspy', 'geo'}"
    code = f"import sys, survey.commands.verbs; print(sorted({slow} & set(sys.modules)))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "[]\n"


@pytest.mark.parametrize(
    "module", ["survey.commands.faults", "dataclasses", "typer", "rich", "survey.progress", "geo", "cv2"]
)
def test_ctrl_c_during_an_import_is_one_sentence(tmp_path, module):
    folder = small_survey(tmp_path / "s")
    stop = (
        "import sys\n"
        "class Stop:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            del sys.meta_path[0]\n"
        "            raise KeyboardInterrupt\n"
        f"sys.meta_path.insert(0, Stop())\n{MAIN}"
    )
    result = console("check", folder, code=stop, stdout=subprocess.PIPE)
    # What is read is named before the libraries load.
    said = [line for line in result.stderr.splitlines() if not line.endswith(f" reading {folder}")]
    assert (result.returncode, result.stdout, said) == (STOPPED, "", ["error: stopped"])


@pytest.mark.parametrize("modules", ["survey.run.process, survey.run.stages", "survey.compare.comparison"])
def test_runs_with_exact_poses_and_comparisons_import_nothing_that_only_others_need(modules):
    slow = "{'torch', 'scipy.stats', 'scipy.signal', 'scipy.interpolate', 'matplotlib', 'rasterio'}"
    code = f"import sys, {modules}; print({slow} & set(sys.modules))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "set()\n"


@pytest.mark.parametrize(("asked", "taken"), [(None, "1"), ("3", "3")])
def test_openblas_computes_on_one_thread_unless_somebody_asks_for_more(asked, taken):
    lines = (
        "import os, sys",
        "from survey.commands.app import main",
        "print('numpy' in sys.modules)",
        "sys.argv[1:] = ['--help']",
        "try: main()",
        "except SystemExit: print(os.environ['OPENBLAS_NUM_THREADS'])",
    )
    given = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    if asked is not None:
        given["OPENBLAS_NUM_THREADS"] = asked
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], env=given, capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()[0], done.stdout.split()[-1]) == (0, "False", taken)


# As on a system that is not Unix: no /proc, no fcntl, no resource, but for the libraries that know each system.
_HIDDEN = """
import sys
import psutil
for name in ("fcntl", "resource"):
    sys.modules[name] = None
def refuse(event, arguments):
    if event == "open" and str(arguments[0]).startswith("/proc"):
        frame = sys._getframe(1)
        while frame is not None and "psutil" not in frame.f_code.co_filename:
            frame = frame.f_back
        if frame is None:
            raise FileNotFoundError(f"hidden: {arguments[0]}")
sys.addaudithook(refuse)
"""


def test_help_check_and_the_lock_of_a_run_need_nothing_of_unix(tmp_path):
    def run(code: str, *arguments) -> str:
        command = [sys.executable, "-c", _HIDDEN + code, *map(str, arguments)]
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stderr
        return ended.stdout

    assert "compare" in run(MAIN, "--help")
    assert "water" in run(MAIN, "check", small_survey(tmp_path / "s"))
    held = (
        "from pathlib import Path; from survey.files.paths import locked; from survey.errors import SurveyError\n"
        "folder = Path(sys.argv[1])\n"
        "with locked(folder, busy='{pid}'):\n"
        "    try:\n"
        "        with locked(folder, busy='busy {pid}'): pass\n"
        "    except SurveyError as error: print(error)"
    )
    assert re.match(r"busy \d+", run(held, tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["s"]
