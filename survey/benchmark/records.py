"""Records of a benchmark: cost and accuracy of each process, and their file."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

from geo import write_whole
from survey.errors import SurveyError
from survey.files.json_values import plain

# Of the file's layout; another one is not read.
VERSION = 1
_TABLE = ("version", "machine", "versions", "commit", "records")


@dataclass(frozen=True)
class Cost:
    """Cost of a process, start and imports included."""

    # wall_s, processor_s [s]: processor time is that of all threads
    wall_s: float
    processor_s: float
    peak_bytes: int  # [B]: largest resident memory of the process and its children


@dataclass(frozen=True)
class Errors:
    """Errors of a cloud against the true bed, within the bounds of the survey."""

    n_points: int
    # mean_m, std_m [m]: of the signed distances of the inner 90 %
    mean_m: float
    std_m: float
    rms_m: float  # [m]: of all distances
    completeness: dict[str, float]  # dict: share of the points that cameras see, by tolerance in metres, e.g. "0.05".
    # Share of vertical errors, their median taken off, below 1.96 times the `std` that the points carry, where the
    # surface is no wall; None where they carry none
    coverage: float | None
    # median_m, common_m [m] or None: that median, and the median of `std_common`, which it should lie within 2.6 of
    median_m: float | None = None
    common_m: float | None = None
    # dict of str to (n, sum, sum of squares): signed distances of the inner 90 % by block of the plan [m, m2]: what
    # another result of the same survey is compared with, block by block
    blocks: dict[str, list[float]] = field(default_factory=dict, repr=False)

    @property
    def error_m(self) -> float:
        """Root of mean squared and std squared [m]: what the picture has over the time."""
        return (self.mean_m**2 + self.std_m**2) ** 0.5


@dataclass(frozen=True)
class Record:
    """Record of a method on a survey."""

    # case, method, quality, poses, device: Together the name of the record, see `key`
    case: str
    method: str
    quality: str
    poses: str
    device: str
    exit_code: int  # Of `process`; 3 where a quality gate failed
    costs: tuple[Cost, ...]  # One for each repeat
    errors: Errors | None  # None where no cloud was written; `words` has the reason
    words: str = ""

    @property
    def key(self) -> tuple[str, str, str, str, str]:
        """Key by which records of two files are paired."""
        return self.case, self.method, self.quality, self.poses, self.device


@dataclass(frozen=True)
class Results:
    """All records of a benchmark and where they were measured."""

    # machine, versions: dict of str to str
    machine: dict[str, str]
    versions: dict[str, str]
    commit: str  # Of the working tree, else the hash of the code
    records: tuple[Record, ...]


def write_results(path: Path, results: Results) -> None:
    """Write the results as JSON, a line for each record, whole or not at all."""
    table = {"version": VERSION} | plain(replace(results, records=()))
    head = json.dumps(table, ensure_ascii=False).removesuffix("[]}")
    lines = ",\n".join(json.dumps(plain(record), ensure_ascii=False) for record in results.records)
    with write_whole(path) as stream:
        stream.write(f"{head}[\n{lines}\n]}}\n".encode())


def read_results(path: Path) -> Results:
    """The results in a file of `write_results`.

    Raises
    ------
    SurveyError
        If it is none.
    """
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise SurveyError(f"{path} does not exist; name a file that `bathynerf benchmark` wrote") from error
    except OSError as error:
        raise SurveyError(f"cannot read {path}: {error.strerror}") from error
    except ValueError as error:
        raise SurveyError(f"{path} is no whole JSON file; name one that `bathynerf benchmark` wrote") from error
    if isinstance(table, dict) and table.get("version", VERSION) != VERSION:
        raise SurveyError(f"{path} has the layout {table['version']!r}, expected {VERSION}; measure it again")
    missing = [name for name in _TABLE if not isinstance(table, dict) or name not in table]
    if missing:
        raise SurveyError(
            f"{path} has no {missing[0]!r}, expected {', '.join(_TABLE)}; name a results.json that `bathynerf "
            "benchmark` wrote"
        )
    records = []
    try:
        for entry in table["records"]:
            records.append(_record(entry))
    except (KeyError, TypeError, AttributeError) as error:
        raise SurveyError(
            f"record {len(records) + 1} of {path} has not the fields of layout {VERSION}; measure it again"
        ) from error
    return Results(table["machine"], table["versions"], table["commit"], tuple(records))


def _record(entry: dict) -> Record:
    errors = None if entry["errors"] is None else Errors(**entry["errors"])
    return Record(**(entry | {"costs": tuple(Cost(**cost) for cost in entry["costs"]), "errors": errors}))
