"""The command line: exit codes, one sentence instead of a traceback, and nothing slow before it is needed."""

from __future__ import annotations

import errno
import io
import os
import re
import resource
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from small_survey import CRS, LEVEL, camera_lines, replaced, small_survey, write_image, write_poses
from typer.testing import CliRunner

from geo.errors import EmptyCloud, GeoError
from survey import progress as progress_room
from survey.commands.faults import BAD_INPUT as BAD_INPUT_CODE
from survey.commands.faults import BROKEN_PIPE, OUR_BUG, STOPPED
from survey.commands.verbs import VERBS, app
from survey.errors import SurveyError
from survey.export.product import ExportOptions
from survey.export.registry import PRODUCTS
from survey.progress import Progress, clock
from survey.run.process import QUALITY_GATE_FAILED


def bathynerf(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def fake_module(monkeypatch, name: str, **content) -> None:
    """Put a room that is not under test here out of the way."""
    module = ModuleType(name)
    vars(module).update(content)
    monkeypatch.setitem(sys.modules, name, module)


def spoil_toml(*pairs):
    return lambda folder: (folder / "survey.toml").write_text(replaced(*pairs))


def spoil_poses(old: str, new: str):
    lines = [line.replace(old, new) for line in camera_lines()]
    assert lines != camera_lines()
    return lambda folder: write_poses(folder, lines)


def remove_toml(folder: Path):
    (folder / "survey.toml").unlink()


def remove_images(folder: Path):
    for image in (folder / "images").iterdir():
        image.unlink()


def cut_image(folder: Path):
    path = folder / "images" / "0003.jpg"
    path.write_bytes(path.read_bytes()[:1200])


BAD_INPUT = {
    "no survey.toml": (remove_toml, ["no survey.toml", "GPS position", 'crs = "EPSG']),
    "unknown key": (spoil_toml(("level_m", "levl_m")), ["survey.toml", "unknown key levl_m", "[water] level_m"]),
    "no images": (remove_images, ["no images in", "images"]),
    "truncated JPEG": (cut_image, ["0003.jpg", "damaged or cut off", "copy it again"]),
    "wrong image size": (
        lambda folder: write_image(folder / "images" / "0002.jpg", size=(60, 48)),
        ["0002.jpg has 60 x 48 pixels, expected 64 x 48", "use the images that the poses were made from"],
    ),
    "NaN pose": (spoil_poses(",0,0,20", ",0,0,nan"), ["cameras.csv, line 4: kappa is nan", "correct it"]),
    "camera under the water": (
        spoil_poses("589018.000,5194732.000,2125", "589018.000,5194732.000,2104"),
        ["0002.jpg at 2104.00 m lies 1.00 m under the water", "correct its pose"],
    ),
    "no vertical part": (spoil_toml((CRS, "EPSG:25832")), ["survey.toml", "no vertical part", "EPSG:25832+5778"]),
    "level too high": (spoil_toml((str(LEVEL), "2605")), ["level_m is 2605 m", "2125.0", "same vertical datum"]),
    "level too low": (spoil_toml((str(LEVEL), "1605")), ["level_m is 1605 m", "2125.0", "same vertical datum"]),
    "poses that do not exist": (spoil_toml(("cameras.csv", "sparse/0")), ["sparse/0 do not exist", "[cameras] poses"]),
    "two views": (
        lambda folder: [(folder / "images" / f"000{i}.jpg").unlink() for i in (0, 1)],
        ["only 2 of the 4 poses", "expected at least 3"],
    ),
    "not yet": (spoil_toml(("level_at", "mask = 'm'\nlevel_at")), ["mask is not supported yet", "remove it"]),
    "two levels": (spoil_toml(("level_at", "gauge = 'g.csv'\nlevel_at")), ["level_m and gauge", "keep one"]),
}


@pytest.mark.parametrize("case", BAD_INPUT)
def test_bad_input_ends_with_code_2_and_one_sentence_that_names_it_and_the_mend(tmp_path, case):
    spoil, words = BAD_INPUT[case]
    folder = small_survey(tmp_path / "s")
    spoil(folder)
    result = bathynerf("check", folder)
    assert result.exit_code == 2
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert "Traceback" not in line
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    "arguments",
    [
        ("check", "nowhere"),
        ("process", "nowhere"),
        ("export", "nowhere", "--las", "a.las"),
        ("compare", "no.las", "no.ply"),
    ],
    ids=lambda arguments: arguments[0],
)
def test_a_path_that_does_not_exist_ends_with_code_2_and_is_named(tmp_path, arguments):
    command, *paths = arguments
    result = bathynerf(command, *[p if p.startswith("--") else tmp_path / p for p in paths])
    assert result.exit_code == 2
    assert re.search(r"error: .*(nowhere|no\.las|no\.ply)", result.stderr)
    assert "Traceback" not in result.stderr


def test_check_of_a_good_survey_prints_findings_and_plan_and_ends_with_code_0(tmp_path):
    folder = small_survey(tmp_path / "s")
    result = bathynerf("check", folder)
    assert result.exit_code == 0
    assert result.stderr == ""
    for words in ("Found\n", "Plan\n", "  water", "  refraction", "on: water of index 1.3330 at 2105 m"):
        assert words in result.stdout


def test_one_q_leaves_out_the_progress_and_two_the_results_too(monkeypatch):
    def process(*_args, **_options):
        progress_room.current().note("a note")
        progress_room.current().warn("a doubt")
        return 3

    fake_module(monkeypatch, "survey.run.process", process=process)
    paths = "s/bathynerf/cloud.las\ns/bathynerf/report.html\n"
    for options, stdout, stderr in (
        ((), paths, "a note\nwarning: a doubt\n"),
        (("-q",), paths, "warning: a doubt\n"),
        (("-qq",), "", ""),
    ):
        result = bathynerf("process", "s", *options)
        assert (result.exit_code, result.stdout, result.stderr) == (3, stdout, stderr)


@pytest.mark.parametrize("quiet", [(), ("-q",), ("-qq",)])
def test_an_error_is_said_however_quiet_the_command_is(monkeypatch, quiet):
    fake_module(monkeypatch, "survey.run.process", process=raising(SurveyError("wrong")))
    assert bathynerf("process", "s", *quiet).stderr == "error: wrong\n"


def test_a_quiet_check_and_comparison_still_print_what_they_found(monkeypatch, tmp_path):
    folder = small_survey(tmp_path / "s")
    assert bathynerf("check", folder, "-q").stdout == bathynerf("check", folder).stdout
    assert bathynerf("check", folder, "-qq").stdout == ""
    options = SimpleNamespace(CompareOptions=SimpleNamespace, compare_files=lambda *_, **__: "figures")
    fake_module(monkeypatch, "survey.compare.comparison", **vars(options))
    fake_module(monkeypatch, "survey.compare.text", sections_of=lambda _: [(None, [("n points", "12")])])
    assert bathynerf("compare", "c.las", "r.ply", "-q").stdout == "n points  12\n"
    assert bathynerf("compare", "c.las", "r.ply", "-qq").stdout == ""


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("verb", [None, *(verb.__name__.rpartition(".")[2] for verb in VERBS)])
def test_every_page_of_help_has_an_example_and_breaks_no_word(verb, width, monkeypatch, capsys):
    def page(columns: int) -> str:
        monkeypatch.setenv("COLUMNS", str(columns))
        app([verb, "--help"] if verb else ["--help"], standalone_mode=False, prog_name="bathynerf")
        return capsys.readouterr().out

    narrow = page(width)
    assert max(map(len, narrow.splitlines())) <= width
    # The same words, however the lines are broken.
    assert sorted(narrow.split()) == sorted(page(200).split())
    examples = re.findall(r"^    bathynerf (.*)", narrow.partition("Examples:\n")[2].replace("\\\n", ""), re.MULTILINE)
    assert examples
    for example in examples:
        name, *words = example.split()
        assert verb in (None, name)
        for option in (word for word in words if word.startswith("-")):
            assert re.search(rf"(^|\W){option}\b", narrow), f"{option} is not explained"


def test_units_in_brackets_are_shown():
    assert "this level [m]" in bathynerf("waterline", "--help").stdout
    assert "F-score [m]" in bathynerf("compare", "--help").stdout


def test_help_lists_the_exit_codes():
    listed = re.findall(r"^    (\d+) ", bathynerf("--help").stdout, re.MULTILINE)
    assert [int(code) for code in listed] == [0, OUR_BUG, BAD_INPUT_CODE, QUALITY_GATE_FAILED, STOPPED, BROKEN_PIPE]


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


def test_process_hands_its_options_on_and_returns_the_code_of_the_pipeline(monkeypatch, tmp_path):
    calls = []

    def process(*args, **options):
        calls.append((args, options, progress_room.current().verbosity))
        return 3

    fake_module(monkeypatch, "survey.run.process", process=process)
    result = bathynerf(
        "process", "s", "-o", "run", "--quality", "draft", "--device", "cpu", "--no-resume", "--field", "slab",
        "--calibrate-water", "--true-colour", "--reference", "r.ply", "--visible", "v.ply", "-v",
        "--target-std", "0.02", "--time-budget", "300",
    )  # fmt: skip
    assert result.exit_code == 3
    assert calls[0][1].pop("time_gone_s") > 0.0
    expected = {
        "quality": "draft",
        "target_std_m": 0.02,
        "time_budget_s": 300.0,
        "device": "cpu",
        "field": "slab",
        "poses": "auto",
        "plan": "auto",
        "image_scale": None,
        "resume": False,
        "calibrate_water": True,
        "true_colour": True,
        "reference": Path("r.ply"),
        "visible": Path("v.ply"),
    }
    assert calls == [((Path("s"), Path("run")), expected, 1)]
    bathynerf("process", "s")
    del calls[1][1]["time_gone_s"]
    aim = {"quality": None, "target_std_m": None, "time_budget_s": None}
    defaults = {"device": "auto", "field": "auto", "resume": True, "calibrate_water": False}
    others = {
        "poses": "auto",
        "plan": "auto",
        "image_scale": None,
        "true_colour": False,
        "reference": None,
        "visible": None,
    }
    assert calls[1] == ((Path("s"), None), {**aim, **defaults, **others}, 0)


def test_export_needs_something_to_write_and_prints_what_it_wrote(monkeypatch):
    result = bathynerf("export", "run")
    assert result.exit_code == 2
    assert "give at least one of --las F" in result.stderr
    calls = []

    def export(run, **files):
        calls.append((run, files))
        return [Path("a.las"), Path("b.ply")]

    fake_module(monkeypatch, "survey.export.export", export=export)
    result = bathynerf("export", "run", "--las", "a.las", "--ply", "b.ply", "--crs", "EPSG:32632", "--fill", "0.5")
    assert (result.exit_code, result.stdout) == (0, "a.las\nb.ply\n")
    ((run, files),) = calls
    assert (run, files.pop("options")) == (Path("run"), ExportOptions(crs="EPSG:32632", fill_m=0.5))
    assert files.keys() == {product.option for product in PRODUCTS}
    assert {name: path for name, path in files.items() if path} == {"las": Path("a.las"), "ply": Path("b.ply")}


def test_compare_hands_its_options_on_and_prints_the_lines_in_columns(monkeypatch):
    @dataclass(frozen=True)
    class CompareOptions:
        tolerances_m: tuple[float, ...]
        visible: Path | None
        bounds: tuple[float, ...] | None
        sign: str
        water_level: float | None
        checkpoints: Path | None
        outliers: str | None
        c2c: bool
        m3c2_radius_m: float | None
        json_path: Path | None
        report_dir: Path | None

    calls = []

    def compare_files(cloud, reference, *, options):
        calls.append((cloud, reference, options))
        return "figures"

    sections = {
        "figures": [(None, [("n points", "12"), ("completeness", "0.9000")]), ("By depth", [("0 to 1 m", "mean 0.1")])]
    }
    fake_module(monkeypatch, "survey.compare.comparison", CompareOptions=CompareOptions, compare_files=compare_files)
    fake_module(monkeypatch, "survey.compare.text", sections_of=sections.get)
    result = bathynerf("compare", "c.las", "r.ply", "--tolerance", "0.05", "--bounds", "-1", "2", "3", "4.5",
                       "--tolerance", "0.2", "--water-level", "3.5", "--checkpoints", "k.csv", "--outliers", "sor:6,2",
                       "--c2c", "--m3c2", "0.5", "--sign", "winding", "--json", "n.json", "--report", "d",
                       "--visible", "v.ply")  # fmt: skip
    assert result.exit_code == 0
    assert result.stdout.splitlines() == [
        "n points      12",
        "completeness  0.9000",
        "",
        "By depth",
        "0 to 1 m  mean 0.1",
    ]
    options = CompareOptions((0.05, 0.2), Path("v.ply"), (-1.0, 2.0, 3.0, 4.5), "winding", 3.5, Path("k.csv"),
                             "sor:6,2", True, 0.5, Path("n.json"), Path("d"))  # fmt: skip
    assert calls == [(Path("c.las"), Path("r.ply"), options)]


def caused_by(error: Exception, cause: BaseException) -> Exception:
    error.__cause__ = cause
    return error


def raising(error):
    def process(*_args, **_options):
        raise error

    return process


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (SurveyError("a survey is wrong; mend it"), 2, "a survey is wrong; mend it"),
        (EmptyCloud("cloud.las has no points"), 2, "cloud.las has no points"),
        (OSError(errno.ENOSPC, "No space left on device"), 2, "cannot write run: no space is left on the disk"),
        (
            OSError(errno.ENOSPC, "No space left", "run/a.npy"),
            2,
            "cannot write run/a.npy: no space is left on the disk",
        ),
        (RuntimeError("database or disk is full"), 2, "cannot write run: no space is left on the disk"),
        (PermissionError(errno.EACCES, "Permission denied", "run/log"), 2, "cannot use run/log: permission is denied"),
        (FileNotFoundError(errno.ENOENT, "No such file", "r.ply"), 2, "cannot use r.ply: it does not exist"),
        (OSError(errno.EIO, "Input/output error"), 2, "the disk reports a fault"),
        (MemoryError(), 2, "memory ran out; use --quality draft"),
        (
            RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"),
            2,
            "memory ran out",
        ),
        (RuntimeError("jit_malloc(): out of memory! Could not allocate 8 bytes"), 2, "memory ran out"),
        (RuntimeError("OpenCV(4.9) (-4:Insufficient memory) Failed to allocate 8 bytes"), 2, "memory ran out"),
        (RuntimeError("bad allocation"), 2, "memory ran out"),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), 2, "memory ran out"),
        (ImportError("x.so: failed to map segment from shared object: Operation not permitted"), 1, "a bug in"),
        (OSError(errno.ENOMEM, "Cannot allocate memory", "torch"), 2, "memory ran out"),
        (caused_by(GeoError("c.las is damaged"), MemoryError()), 2, "memory ran out"),
        (caused_by(ImportError("numpy failed"), KeyboardInterrupt()), 130, "stopped; finished work is kept"),
        (KeyboardInterrupt(), 130, "stopped; finished work is kept"),
        (RuntimeError("no such tile"), 1, "RuntimeError: no such tile; this is a bug in bathynerf, -v shows where"),
        (
            OSError(errno.EINVAL, "Invalid argument"),
            1,
            "OSError: [Errno 22] Invalid argument; this is a bug in bathynerf",
        ),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_every_error_becomes_a_sentence_and_its_exit_code(monkeypatch, tmp_path, error, code, words):
    fake_module(monkeypatch, "survey.run.process", process=raising(error))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    result = bathynerf("process", "s", "-o", "run")
    assert result.exit_code == code
    (line,) = result.stderr.splitlines()
    assert words in line


def test_our_own_fault_leaves_its_traceback_in_the_log_and_shows_it_when_asked(monkeypatch, tmp_path):
    log = tmp_path / "run" / "log.txt"

    def process(*_args, **_options):
        progress_room.current().log_to(log)
        raise RuntimeError("no such tile")

    fake_module(monkeypatch, "survey.run.process", process=process)
    assert "Traceback" not in bathynerf("process", "s").stderr
    assert "in process\n    raise RuntimeError" in log.read_text()
    assert "error: RuntimeError: no such tile" in log.read_text()
    assert "Traceback" in bathynerf("process", "s", "-v").stderr


@pytest.mark.parametrize("arguments", [("process", "s"), ("waterline", "s"), ("simulate", "s.toml", "-o", "s")])
def test_a_limit_on_memory_below_what_any_survey_needs_is_refused(monkeypatch, arguments):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1_536_000_000, resource.RLIM_INFINITY))
    result = bathynerf(*arguments)
    assert result.exit_code == 2
    assert "limited to 1.5 GB (ulimit -v), expected at least 3 GB; raise the limit" in result.stderr


def test_a_limit_on_data_that_kernels_would_crash_at_is_refused(monkeypatch):
    endless = resource.RLIM_INFINITY
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (3e8 if kind == resource.RLIMIT_DATA else endless, endless))
    result = bathynerf("process", "s")
    assert result.exit_code == 2
    assert "limited to 0.3 GB (ulimit -d), expected at least 0.4 GB; raise the limit" in result.stderr


def test_check_warns_of_the_limit_that_process_refuses(monkeypatch, tmp_path):
    monkeypatch.setattr(resource, "getrlimit", lambda _: (1_536_000_000, resource.RLIM_INFINITY))
    result = bathynerf("check", small_survey(tmp_path / "s"))
    assert result.exit_code == 0
    sentence = bathynerf("process", "s").stderr.removeprefix("error: ")
    assert result.stderr == f"warning: {sentence}"
    assert sentence.startswith("the address space of this process is limited to 1.5 GB")


def test_ctrl_c_before_there_is_a_run_folder_promises_nothing(monkeypatch, tmp_path):
    fake_module(monkeypatch, "survey.run.process", process=raising(KeyboardInterrupt()))
    assert bathynerf("process", "s", "-o", tmp_path / "run").stderr == "error: stopped\n"
    (tmp_path / "run").mkdir()
    assert "finished work is kept" in bathynerf("process", "s", "-o", tmp_path / "run").stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("check", "s", "--quality", "high"), "invalid value for '--quality': 'high' is not one of 'draft'"),
        (("check",), "missing argument 'SURVEY|PLAN'"),
        (("check", "s", "--colour"), "no such option: --colour"),
        (("chek",), "no such command 'chek'"),
    ],
)
def test_an_error_of_usage_is_one_sentence_like_every_other(arguments, words):
    result = bathynerf(*arguments)
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"error: {words}")


def test_files_that_are_missing_are_refused_before_anything_is_said_to_be_read(tmp_path):
    result = bathynerf("compare", tmp_path / "no.las", tmp_path / "no.ply")
    (line,) = result.stderr.splitlines()
    assert line == f"error: {tmp_path / 'no.las'} does not exist; correct the path"


def test_an_error_that_speaks_of_memory_itself_is_said_as_it_is(monkeypatch):
    fake_module(monkeypatch, "survey.run.process", process=raising(SurveyError("out of memory; take 8 GB")))
    assert bathynerf("process", "s").stderr == "error: out of memory; take 8 GB\n"


def test_a_full_disk_under_the_log_does_not_hide_the_error(monkeypatch):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no device that is always full")

    def process(*_args, **_options):
        progress_room.current().log_to(Path("/dev/full"))
        progress_room.current().note("a line that does not fit")

    fake_module(monkeypatch, "survey.run.process", process=process)
    result = bathynerf("process", "s", "-o", "run", "-q")
    assert result.exit_code == 2
    assert result.stderr == ("error: cannot write run: no space is left on the disk; free some or write elsewhere\n")


def test_stages_are_plain_lines_with_the_time_left_where_there_is_no_terminal(monkeypatch, tmp_path):
    now = [0.0]
    monkeypatch.setattr(progress_room.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with Progress(stream=stream, log_path=tmp_path / "run" / "log.txt") as progress:
        assert progress_room.current() is progress
        with progress.stage("sweep", total=4) as stage:
            assert stage.seconds_left is None
            for _ in range(3):
                now[0] += 15.0
                stage.advance(detail="0001.jpg")
        progress.detail("a detail")
        progress.warn("a doubt")
    assert stream.getvalue().splitlines() == [
        "sweep ...",
        "sweep:  50 %, 30 s left, 0001.jpg",
        "sweep: done in 45 s",
        "warning: a doubt",
    ]
    lines = [line.split(" ", 2)[2] for line in (tmp_path / "run" / "log.txt").read_text().splitlines()]
    assert lines == [*stream.getvalue().splitlines()[:3], "a detail", "warning: a doubt"]
    assert progress_room.current() is not progress


def test_a_stage_that_fails_is_not_said_to_be_done():
    stream = io.StringIO()
    with Progress(stream=stream) as progress, pytest.raises(RuntimeError), progress.stage("sweep"):
        raise RuntimeError
    assert stream.getvalue() == "sweep ...\n"


def test_a_quiet_run_says_only_warnings():
    stream = io.StringIO()
    with Progress(stream=stream, verbosity=-1) as progress, progress.stage("sweep"):
        progress.note("a note")
        progress.warn("a doubt")
    assert stream.getvalue() == "warning: a doubt\n"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.04, "0.0 s"), (9.94, "9.9 s"), (9.96, "10 s"), (59.6, "1 min 00 s"), (185, "3 min 05 s"), (7800, "2 h 10 min")],
)
def test_durations_are_for_people(seconds, text):
    assert clock(seconds) == text


MAIN = "import sys; from survey.commands.app import main; sys.argv[0] = 'bathynerf'; main()"


def console(*arguments, code: str = MAIN, **options) -> subprocess.CompletedProcess:
    """The command line in a process of its own, as a shell would start it."""
    command = [sys.executable, "-c", code, *map(str, arguments)]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False, **options)


@pytest.mark.parametrize("arguments", [("--help",), ("check", "{survey}")], ids=lambda arguments: arguments[0])
def test_a_pipe_whose_reader_has_gone_ends_the_command_without_a_word(tmp_path, arguments):
    folder = small_survey(tmp_path / "s")
    reader, writer = os.pipe()
    os.close(reader)
    try:
        result = console(*(word.format(survey=folder) for word in arguments), stdout=writer)
    finally:
        os.close(writer)
    assert (result.returncode, result.stderr) == (BROKEN_PIPE, "")


@pytest.mark.parametrize("arguments", [("--help",), ("check", "{survey}")], ids=lambda arguments: arguments[0])
def test_a_full_device_behind_standard_output_is_said_in_one_sentence(tmp_path, arguments):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no device that is always full")
    folder = small_survey(tmp_path / "s")
    with Path("/dev/full").open("w") as full:
        result = console(*(word.format(survey=folder) for word in arguments), stdout=full)
    assert result.stderr == (
        "error: cannot write standard output: no space is left on the disk; free some or write elsewhere\n"
    )
    assert result.returncode == BAD_INPUT_CODE


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&- <&-"])
def test_closed_standard_streams_do_not_stop_a_command(tmp_path, closed):
    folder = small_survey(tmp_path / "s")
    command = ["sh", "-c", f'exec "$0" "$@" {closed}', sys.executable, "-c", MAIN, "check", str(folder)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert ("Found" in result.stdout) == (closed == "2>&-")


class FullDevice(io.StringIO):
    def write(self, _text):
        raise OSError(errno.ENOSPC, "No space left on device")


def test_a_standard_error_that_is_full_does_not_stop_a_run_nor_its_log(tmp_path):
    with Progress(stream=FullDevice(), log_path=tmp_path / "log.txt") as progress:
        progress.note("a note")
        progress.note("another")
    assert [line.split(" ", 2)[2] for line in (tmp_path / "log.txt").read_text().splitlines()] == ["a note", "another"]


@pytest.mark.parametrize(
    "module", ["survey.commands.streams", "dataclasses", "typer", "rich", "survey.progress", "geo", "cv2"]
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
    assert (result.returncode, result.stdout, result.stderr) == (STOPPED, "", "error: stopped\n")


def test_a_run_without_a_field_imports_no_torch():
    code = "import sys, survey.run.process, survey.run.pipeline; print('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "False\n"


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
