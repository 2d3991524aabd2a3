"""Where does it degrade, how, and do its standard deviations say so? One thing after another is made worse.

    python benchmarks/stress.py [FACTOR ...] [-o FOLDER] [--quality Q] [--publish]

Every factor of stress_factors.py is stepped from harmless to hopeless, everything else as in the small drawn survey
`BASE`; each step is a run of the command line. A run may refuse, in one sentence, or say by its exit code that its
cloud failed the quality gate. What it may not do is to lie: of the vertical errors less their median 90 to 99 % lie
within 1.96 `std`, and the median itself within 2.6 of the median `std_common`. Faults of the machine (memory, disk,
kill) may stop a run, but the run that follows must end with the same bytes as if nothing had been. Writes stress.json
and stress.png into the folder, and prints a table; --publish draws docs/img/stress.png.
Steps that stress.json of the folder has are not run again; exit code 1 says that something lied.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from bench_methods import run_bathynerf
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from method_cases import case_of
from method_records import Cost, Errors, errors_of
from stress_factors import FACTORS, prepared
from stress_faults import resumed

from survey.display.canvas import save
from survey.display.palette import BLUE, DOUBTFUL, INK, RED, SOFT

# Shares of errors that count as 95 %, and standard deviations that a median may be off by.
LEAST, MOST, MOST_SIGMAS = 0.90, 0.99, 2.6
BAD_INPUT, GATE_FAILED = 2, 3
TRUE, REFUSED, TOO_LARGE = "true", "refused", "std too large"
COLUMNS = 5
RESULTS, PICTURE = "stress.json", "stress.png"
DOCS = Path(__file__).resolve().parent.parent / "docs"


@dataclass(frozen=True)
class Outcome:
    """One step of one factor.

    Attributes
    ----------
    factor, value : which step
    exit_code : int
    processor_s : [s]
        Of all threads, imports included.
    errors : Errors or None
        None where no cloud was written; of a fault, those of the run that was resumed.
    words : str
        The last line of a run without a cloud, or of one that a fault has stopped.
    ending : str
        How a run under a fault ended; see `stress_faults.Resumed.verdict`.
    """

    factor: str
    value: float
    exit_code: int
    processor_s: float
    errors: Errors | None
    words: str = ""
    ending: str = ""

    @classmethod
    def from_json(cls, entry: dict) -> Outcome:
        """The outcome of an entry of stress.json."""
        fields = {name: entry[name] for name in cls.__dataclass_fields__}
        errors = entry["errors"]
        return cls(**(fields | {"errors": None if errors is None else Errors(**errors)}))

    @property
    def sigmas(self) -> float:
        """Median error over the median of std_common."""
        if self.errors is None or self.errors.median_m is None or not self.errors.common_m:
            return float("nan")
        return abs(self.errors.median_m) / self.errors.common_m

    @property
    def verdict(self) -> str:
        """Whether it is as good as it says."""
        if self.errors is None or self.errors.coverage is None:
            return REFUSED if self.exit_code == BAD_INPUT else f"crashed (exit code {self.exit_code})"
        if self.ending:
            return self.ending
        if self.sigmas > MOST_SIGMAS:
            return "std_common too small"
        if self.errors.coverage < LEAST:
            return "std too small"
        return TOO_LARGE if self.errors.coverage > MOST else TRUE

    @property
    def is_lie(self) -> bool:
        """Whether a cloud that passed the gate is worse than it says, or a fault was not survived.

        A std that is too large is a flaw and no lie.
        """
        if self.ending:
            return not any(words in self.ending for words in ("same bytes", "not measured"))
        return self.verdict not in (TRUE, REFUSED, TOO_LARGE) and self.exit_code != GATE_FAILED


def row_of(outcome: Outcome) -> str:
    """One line of the table."""
    errors, start = outcome.errors, f"| {FACTORS[outcome.factor].words} | {outcome.value:g} |"
    words = f": {outcome.words.removeprefix('error: ')[:200]}" if outcome.words else ""
    if errors is None or errors.coverage is None:
        return f"{start} | | | | | {outcome.processor_s:.0f} s | {outcome.verdict}{words} |"
    gate = ", quality gate failed" if outcome.exit_code == GATE_FAILED else ""
    return (
        f"{start} {1e3 * errors.mean_m:.1f} mm | {1e3 * errors.std_m:.1f} mm | "
        f"{100.0 * errors.completeness['0.05']:.1f} % | {100.0 * errors.coverage:.1f} % | {outcome.sigmas:.1f} | "
        f"{outcome.processor_s:.0f} s | {outcome.verdict}{gate}{words} |"
    )


def table(outcomes: list[Outcome]) -> str:
    """The table of all steps, in Markdown."""
    head = "| factor | value | mean | std | complete at 0.05 m | std covers | median error / std_common | processor | |"
    return "\n".join([head, "|" + 9 * "---|", *(row_of(outcome) for outcome in outcomes)])


def draw(path: Path, outcomes: list[Outcome]) -> None:
    """A panel for each factor that makes a cloud worse; faults of the machine have none."""
    names = list(dict.fromkeys(o.factor for o in outcomes if not o.ending))
    rows = max(-(-len(names) // COLUMNS), 1)
    figure = Figure(figsize=(2.7 * COLUMNS, 2.3 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for panel, name in zip(panels, names, strict=False):
        _panel(panel, [o for o in outcomes if o.factor == name])
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    if names:
        panels[0].legend(fontsize=7, frameon=False)
    save(figure, path)


def _panel(panel: Axes, steps: list[Outcome]) -> None:
    """Mean and std over the steps, and above them the share that the std covers."""
    at, known = np.arange(len(steps)), [o.errors for o in steps]
    panel.plot(at, [np.nan if e is None else 1e3 * e.std_m for e in known], "o-", color=BLUE, label="std [mm]")
    panel.plot(
        at, [np.nan if e is None else 1e3 * abs(e.mean_m) for e in known], "s--", color=SOFT, ms=4, label="|mean| [mm]"
    )
    panel.set(yscale="log", xticks=at, xticklabels=[f"{o.value:g}" for o in steps], xlim=(-0.5, len(steps) - 0.5))
    # Panels of less than a decade would have ticks of their own form, and other panels none between decades.
    panel.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=6))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())
    panel.tick_params(labelsize=7)
    panel.set_title(FACTORS[steps[0].factor].words, fontsize=9, color=INK, pad=22)
    for x, o in zip(at, steps, strict=True):
        if o.errors is None or o.errors.coverage is None:
            text, colour = o.verdict, INK if o.verdict == REFUSED else RED
        else:
            text = f"{100.0 * o.errors.coverage:.0f} %"
            colour = RED if o.is_lie else DOUBTFUL if o.verdict == TOO_LARGE else INK
        if o.exit_code == GATE_FAILED:
            text, colour = f"gate\n{text}", SOFT
        panel.annotate(text, (x, 1.0), xycoords=("data", "axes fraction"), textcoords="offset points", xytext=(0, 3),
                       ha="center", fontsize=7, color=colour)  # fmt: skip


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
        return errors_of(run / "cloud.las", case_of(survey))


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
        draw(DOCS / "img" / PICTURE, ordered)
    sys.exit(1 if any(o.is_lie for o in ordered) else 0)


if __name__ == "__main__":
    main()
