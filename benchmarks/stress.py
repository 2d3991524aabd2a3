"""Where does it degrade, how, and do its standard deviations say so? One thing after another is made worse.

    python benchmarks/stress.py [FACTOR ...] [-o FOLDER] [--quality Q] [--publish]

Every factor of stress_factors.py is stepped from harmless to hopeless, everything else as in the small drawn survey
`BASE`; each step is a run of the command line. A run may refuse, in one sentence, or say by its exit code that its
cloud failed the quality gate. What it may not do is to lie: of the vertical errors less their median 90 to 99 % lie
within 1.96 `std`, and the median itself within 2.6 of the median `std_common`. Faults of the machine (memory, disk,
kill) may stop a run, but the run that follows must end with the same bytes as if nothing had been. Writes stress.json
and stress.png into the folder, and prints the table of docs/notes/stress.md, into which --publish writes it. Steps that
stress.json of the folder has are not run again; exit code 1 says that something lied.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import asdict, replace
from pathlib import Path

from published import publish
from stress_factors import FACTORS, prepared
from stress_faults import resumed
from stress_outcome import BAD_INPUT, Outcome, draw, row_of, table

from survey.benchmark.benchmark import run_bathynerf
from survey.benchmark.cases import case_of
from survey.benchmark.records import Cost, Errors, errors_of

RESULTS, PICTURE = "stress.json", "stress.png"
DOCS = Path(__file__).resolve().parent.parent / "docs"


class Campaign:
    """Runs of one quality in a folder.

    Compiled kernels are kept from run to run, so that times are those of a warm start.
    """

    def __init__(self, folder: Path, quality: str):
        self._folder, self._options = folder, ["--quality", quality]
        self._home = folder / "home"
        self._home.mkdir(parents=True, exist_ok=True)
        self._whole: tuple[Path, Cost] | None = None

    def step(self, name: str, value: float) -> Outcome:
        """Run one step; its survey and its run are removed afterwards."""
        factor = FACTORS[name]
        if factor.fault is not None:
            return self._under_fault(name, value)
        survey = prepared(factor, value, self._folder / f"{name}_{value:g}")
        run = survey / "run"
        code, cost, words = run_bathynerf(["process", str(survey), "-o", str(run), *self._options], self._home)
        errors = self._errors(run, survey)
        shutil.rmtree(survey)
        return Outcome(name, value, code, cost.processor_s, errors, "" if errors else self._without_folder(words))

    def _under_fault(self, name: str, value: float) -> Outcome:
        fault, survey = FACTORS[name].fault, self._folder / "undisturbed"
        assert fault is not None
        if self._whole is None:
            prepared(FACTORS[name], value, survey)
            # The first one compiles; the second takes the time that a run takes.
            for number in range(2):
                run = self._folder / f"whole{number}"
                shutil.rmtree(run, ignore_errors=True)
                _, cost, _ = run_bathynerf(["process", str(survey), "-o", str(run), *self._options], self._home)
                self._whole = run, cost
        assert self._whole is not None
        place = self._folder / f"{name}_{value:g}"
        found = resumed(fault, value, survey, place, self._whole, self._home, self._options)
        errors = self._errors(found.run, survey)
        shutil.rmtree(place)
        words = self._without_folder(found.words) if found.exit_code == BAD_INPUT else ""
        return Outcome(name, value, found.exit_code, found.cost.processor_s, errors, words, found.verdict)

    def _without_folder(self, words: str) -> str:
        return words.replace(f"{self._folder}/", "")

    @staticmethod
    def _errors(run: Path, survey: Path) -> Errors | None:
        if not (run / "cloud.las").is_file():
            return None
        return replace(errors_of(run / "cloud.las", case_of(survey)), blocks={})


def read(path: Path) -> dict[tuple[str, float], Outcome]:
    """The steps that were run before."""
    if not path.is_file():
        return {}
    outcomes = (Outcome.from_json(entry) for entry in json.loads(path.read_text(encoding="utf-8")))
    return {(outcome.factor, outcome.value): outcome for outcome in outcomes}


def main() -> None:
    """Run the factors that are asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("factors", nargs="*", metavar="FACTOR", help=f"default: all of {' '.join(FACTORS)}")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--quality", default="standard")
    parser.add_argument("--publish", action="store_true", help="into docs")
    options = parser.parse_args()
    unknown = [name for name in options.factors if name not in FACTORS]
    if unknown:
        parser.error(f"factor is {unknown[0]}, expected one of {', '.join(FACTORS)}")
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_stress_"))
    campaign, found = Campaign(folder, options.quality), read(folder / RESULTS)
    for name in options.factors or FACTORS:
        for value in FACTORS[name].values:
            if (name, value) not in found:
                found[name, value] = campaign.step(name, value)
                print(row_of(found[name, value]), flush=True)  # noqa: T201
            ordered = [found[n, v] for n, factor in FACTORS.items() for v in factor.values if (n, v) in found]
            records = [asdict(o) | {"verdict": o.verdict} for o in ordered]
            (folder / RESULTS).write_text(json.dumps(records, indent=1) + "\n", encoding="utf-8")
            draw(folder / PICTURE, ordered)
    print(f"\n{table(ordered)}\n\n{folder / RESULTS}")  # noqa: T201
    if options.publish:
        publish(DOCS / "notes" / "stress.md", "stress", table(ordered).split("\n"))
        draw(DOCS / "img" / PICTURE, ordered)
    sys.exit(1 if any(o.is_lie for o in ordered) else 0)


if __name__ == "__main__":
    main()
