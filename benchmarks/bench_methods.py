"""Run time against error of the whole chain, of its parts, and of straight rays with their depths corrected.

    python benchmarks/bench_methods.py SURVEY ... -o FOLDER [--drawn DEPTH,PATTERN,IMAGES] [--repeats N]
        [--against before/results.json]

Every method runs on every survey in a process of its own, round after round. FOLDER takes drawn surveys and runs,
results.json and front.png, the picture of time over error; prints a table, and what has changed against earlier
results.
"""

import argparse
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import psutil
from method_cases import GIVEN, POSES, Case, case_of, drawn_case, drawn_names, variant
from method_records import (
    METHODS,
    Cost,
    Method,
    Record,
    Results,
    errors_of,
    read_results,
    write_corrected,
    write_results,
)
from method_text import comparison, draw_pareto_front, table

from fields.device import choose_device
from geo.errors import GeoError
from survey.errors import SurveyError
from survey.machine import memory_bytes, num_cores
from survey.progress import current
from survey.run.folder import versions
from survey.stage_key import code_hash
from survey.words import Quality, instead_of_word

_BATHYNERF = (sys.executable, "-c", "from survey.commands.app import main; main()")
_ROOT = Path(__file__).resolve().parent.parent
# Between two looks at the memory [s].
_LOOK_S = 0.05
RESULTS, FRONT = "results.json", "front.png"
_CLOUD = "cloud.las"


def run_bathynerf(arguments: list[str], home: Path, *, under: tuple[str, ...] = ()) -> tuple[int, Cost, str]:
    """Run the command line in a process of its own, with its compiled kernels in `home`.

    `under` is a command that runs the command after it, e.g. ("timeout", "60"). Returns exit code, cost and the last
    line of standard error.
    """
    environment = {**os.environ, "HOME": str(home), "PYTHONPATH": os.pathsep.join([str(_ROOT), *sys.path])}
    log = home / "stderr.txt"
    start, before = time.monotonic(), os.times()
    with log.open("wb") as errors:
        process = subprocess.Popen(
            [*under, *_BATHYNERF, *arguments], env=environment, stdout=subprocess.DEVNULL, stderr=errors
        )
        peak = PeakMemory(process.pid)
        try:
            code = process.wait()
        except BaseException:
            process.terminate()
            process.wait()
            raise
        finally:
            peak.stop()
    wall, after = time.monotonic() - start, os.times()
    processor = (after.children_user - before.children_user) + (after.children_system - before.children_system)
    words = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return code, Cost(wall, processor, peak.resident), words[-1] if words else ""


class PeakMemory:
    """Peak memory [bytes] of a process and its descendants, watched in a thread.

    ``resident`` is that of all of them together; ``own`` and ``child``, of the process and of its largest descendant,
    leave out what they share with others, such as libraries.
    """

    def __init__(self, pid: int):
        self.resident = self.own = self.child = 0
        self._process, self._ended = psutil.Process(pid), threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._ended.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK_S):
            resident = 0
            # Some may have just ended.
            with suppress(psutil.Error):
                for member in (self._process, *self._process.children(recursive=True)):
                    with suppress(psutil.Error):
                        memory = member.memory_info()
                        resident += memory.rss
                        private = memory.rss - getattr(memory, "shared", 0)
                        if member is self._process:
                            self.own = max(self.own, private)
                        else:
                            self.child = max(self.child, private)
            self.resident = max(self.resident, resident)


def machine() -> dict[str, str]:
    """Processor, cores, memory and system, in words."""
    return {
        "processor": _processor(),
        "cores": str(num_cores()),
        "memory": f"{memory_bytes() / 1024**3:.1f} GiB",
        "gpu": _gpu(),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def commit() -> str:
    """The commit of the working tree, with + where files differ; the hash of the code where there is no repository."""
    git = shutil.which("git")
    if git is not None and (_ROOT / ".git").exists():
        words = [git, "-C", str(_ROOT), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
        found = subprocess.run(words, capture_output=True, text=True, check=False)
        if found.returncode == 0:
            return found.stdout.strip()
    return code_hash()[:12]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    flags = next((line.partition(":")[2].split() for line in lines if line.startswith("flags")), [])
    width = next((text for flag, text in (("avx512f", "AVX-512"), ("avx2", "AVX2")) if flag in flags), "")
    return ", ".join(filter(None, [named[0] if named else platform.machine(), width]))


def _gpu() -> str:
    nvidia = shutil.which("nvidia-smi")
    if nvidia is None:
        return "none"
    words = [nvidia, "--query-gpu=name", "--format=csv,noheader"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return found.stdout.strip().replace("\n", ", ") or "none"


@dataclass(frozen=True)
class Settings:
    """Settings of a benchmark: methods, qualities, poses."""

    methods: tuple[str, ...] = tuple(METHODS)  # names of `METHODS`
    # qualities, poses, devices: As `process` has them; poses are "given" and "images"
    qualities: tuple[str, ...] = ("draft", "standard", "fine")
    poses: tuple[str, ...] = (GIVEN,)
    devices: tuple[str, ...] = ("cpu",)
    repeats: int = 1  # Rounds; times are those of all of them, clouds of the first

    def __post_init__(self):
        unknown = [name for name in self.methods if name not in METHODS]
        if unknown:
            raise SurveyError(
                f"--method is {unknown[0]}, expected one of {', '.join(METHODS)}{instead_of_word(unknown[0])}"
            )
        strange = [name for name in self.poses if name not in POSES]
        if strange:
            raise SurveyError(f"--poses is {strange[0]}, expected one of {', '.join(POSES)}")
        if self.repeats < 1:
            raise SurveyError(f"--repeats is {self.repeats}, expected at least 1")


@dataclass(frozen=True)
class _Job:
    """Process of the benchmark: methods that differ by a correction share it."""

    case: Case
    methods: tuple[Method, ...]
    quality: str
    poses: str
    device: str

    @property
    def name(self) -> str:
        first = self.methods[0]
        kind = first.field if first.is_refracted else "straight"
        return "_".join((self.case.name, kind, self.quality, self.poses, self.device))

    @property
    def keys(self) -> set[tuple[str, ...]]:
        """Keys of its records."""
        return {(self.case.name, method.name, self.quality, self.poses, self.device) for method in self.methods}


def benchmark(
    surveys: Sequence[Path],
    folder: Path,
    *,
    drawn: Sequence[str] = (),
    settings: Settings | None = None,
    known: Sequence[Record] = (),
) -> Results:
    """Measure run time against error on survey folders with a known truth, which are not written to, and drawn surveys.

    The folder takes drawn surveys (`drawn`: names as of `method_cases.drawn_names`), run folders,
    results.json and front.png, which are written anew after every process. `known` are records of an earlier call with
    this code: they are kept, and their processes do not run again.
    """
    settings = settings or Settings()
    if not surveys and not drawn:
        raise SurveyError(
            "no survey is named; give a survey folder with reference.ply, or --drawn, e.g. --drawn 2,oblique,20"
        )
    names = drawn_names(list(drawn))
    cases = [case_of(Path(survey)) for survey in surveys]
    doubled = {case.name for case in cases if [other.name for other in cases].count(case.name) > 1}
    if doubled:
        raise SurveyError(f"two surveys are named {min(doubled)}; rename the folder of one of them")
    folder.mkdir(parents=True, exist_ok=True)
    cases += [drawn_case(name, folder) for name in names]
    found: dict[tuple[str, ...], Record] = {record.key: record for record in known}
    jobs = [job for case in cases for job in _jobs(case, settings) if not job.keys <= found.keys()]
    results = Results(machine(), versions(), commit(), tuple(known))
    with current().stage("Benchmark", len(jobs) * settings.repeats) as stage:
        # Round after round, so that what slows the machine for a while slows all methods.
        for _ in range(settings.repeats):
            for job in jobs:
                current().note(f"benchmark: {job.name}")
                for record in _measure(job, folder, found):
                    found[record.key] = record
                results = replace(results, records=tuple(found.values()))
                write_results(folder / RESULTS, results)
                draw_pareto_front(folder / FRONT, results.records)
                stage.advance()
    return results


def _jobs(case: Case, settings: Settings) -> list[_Job]:
    groups: dict[tuple[str, bool], list[Method]] = {}
    for name in settings.methods:
        method = METHODS[name]
        groups.setdefault((method.field, method.is_refracted), []).append(method)
    return [
        _Job(case, tuple(methods), quality, poses, device)
        for poses in settings.poses
        for device in settings.devices
        for quality in settings.qualities
        for methods in groups.values()
    ]


def _measure(job: _Job, folder: Path, found: dict[tuple[str, ...], Record]) -> list[Record]:
    """The records of a job; where there are some already, with one cost more."""
    first = job.methods[0]
    straight = "" if first.is_refracted else "_straight"
    survey = variant(
        job.case, folder / f"{job.case.name}_{job.poses}{straight}", poses=job.poses, is_refracted=first.is_refracted
    )
    run = folder / "runs" / job.name
    options = ["--quality", job.quality, "--field", first.field, "--device", job.device, "--no-resume"]
    if job.poses == GIVEN and not first.is_refracted:
        # Without the water photographs contradict true poses and lenses, and would have them adjusted to straight rays.
        options += ["--poses", "fixed"]
    # Dr.Jit keeps its compiled kernels in the home folder: a new one is a cold start.
    with tempfile.TemporaryDirectory() as home:
        code, cost, words = run_bathynerf(["process", str(survey), "-o", str(run), *options], Path(home))
    records = []
    for method in job.methods:
        record = Record(job.case.name, method.name, job.quality, job.poses, job.device, code, (cost,), None, words)
        before = found.get(record.key)
        if before is not None:
            records.append(replace(before, costs=(*before.costs, cost)))
            continue
        records.append(_with_errors(record, job, method, run, folder))
    return records


def _with_errors(record: Record, job: _Job, method: Method, run: Path, folder: Path) -> Record:
    """The record with the errors of its cloud; its words give the reason where there are none."""
    cloud = run / _CLOUD
    if not cloud.is_file():
        return record
    try:
        if method.correction:
            survey = variant(job.case, folder / f"{job.case.name}_{job.poses}", poses=job.poses, is_refracted=True)
            cloud = run / f"{method.correction}.las"
            write_corrected(cloud, run, survey, method.correction)
        return replace(record, errors=errors_of(cloud, job.case), words="")
    except (GeoError, SurveyError) as error:
        return replace(record, words=str(error))


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("surveys", nargs="*", type=Path, metavar="SURVEY", help="survey folders with reference.ply")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for all results")
    parser.add_argument("--drawn", action="append", default=[], metavar="D,P,N",
                        help="simulate a survey: depth [m], nadir or oblique, images; or all; repeatable")  # fmt: skip
    parser.add_argument("--methods", nargs="+", default=METHODS, metavar="NAME", help=f"default: {' '.join(METHODS)}")
    parser.add_argument("--qualities", nargs="+", default=[*Quality], choices=[*Quality], help="default: all")
    parser.add_argument("--poses", nargs="+", default=[GIVEN], metavar="given|images", help="default: given")
    parser.add_argument("--devices", nargs="+", metavar="cpu|cuda", help="default: all that are present")
    parser.add_argument("--repeats", type=int, default=1, help="rounds; times are medians")
    parser.add_argument("--against", type=Path, metavar="FILE", help="an earlier results.json: list what has changed")
    asked = parser.parse_args()
    present = ("cpu", "cuda") if choose_device("auto").name == "cuda" else ("cpu",)
    try:
        # Read before hours are spent.
        earlier = None if asked.against is None else read_results(asked.against)
        settings = Settings(
            tuple(asked.methods),
            tuple(asked.qualities),
            tuple(asked.poses),
            tuple(asked.devices or present),
            asked.repeats,
        )
        found = benchmark(asked.surveys, asked.output, drawn=asked.drawn, settings=settings)
    except (GeoError, SurveyError) as error:
        parser.error(str(error))
    print("\n".join(table(found) + ([] if earlier is None else ["", *comparison(found, earlier)])))  # noqa: T201


if __name__ == "__main__":
    main()
