"""Where does it degrade, how, and do its standard deviations say so? One thing after another is made worse.

    python benchmarks/stress.py [FACTOR ...] [-o FOLDER] [--quality Q]

Every factor of stress_factors.py is stepped from harmless to hopeless, everything else as in the small drawn survey
`BASE`; each step is a run of the command line. A run may refuse, in one sentence, or say by its exit code that its
cloud failed the quality gate. What it may not do is to lie: of the vertical errors less their median 90 to 99 % lie
within 1.96 `std`, and the median itself within 2.6 of the median `std_common`. Writes stress.json and stress.png into
the folder, and prints the table of docs/stress.md.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from stress_factors import FACTORS, prepared

from survey.benchmark.cases import case_of
from survey.benchmark.measured import errors_of
from survey.benchmark.records import Errors
from survey.benchmark.running import run_bathynerf
from survey.compare.canvas import save
from survey.display.palette import BLUE, INK, RED, SOFT

# Shares of errors that count as 95 %, and standard deviations that a median may be off by.
LEAST, MOST, MOST_SIGMAS = 0.90, 0.99, 2.6
GATE_FAILED = 3
COLUMNS = 4


@dataclass(frozen=True)
class Outcome:
    """One step of one factor; ``errors`` is None where no cloud was written, for a reason in ``words``."""

    factor: str
    value: float
    exit_code: int
    errors: Errors | None
    words: str = ""

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
            return "refused"
        if self.sigmas > MOST_SIGMAS:
            return "std_common too small"
        if self.errors.coverage < LEAST:
            return "std too small"
        return "std too large" if self.errors.coverage > MOST else "true"


def measure(name: str, value: float, folder: Path, quality: str) -> Outcome:
    """Run one step."""
    survey = prepared(FACTORS[name], value, folder / f"{name}_{value:g}")
    run, home = survey / "run", folder / "home"
    # Compiled kernels are kept from run to run: times are not measured here.
    home.mkdir(exist_ok=True)
    code, _, words = run_bathynerf(["process", str(survey), "-o", str(run), "--quality", quality], home)
    if not (run / "cloud.las").is_file():
        return Outcome(name, value, code, None, words)
    return Outcome(name, value, code, errors_of(run / "cloud.las", case_of(survey)))


def table(outcomes: list[Outcome]) -> str:
    """The table of docs/stress.md."""
    lines = [
        "| factor | value | mean | std | complete at 0.05 m | std covers | median error / std_common | |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for o in outcomes:
        start = f"| {FACTORS[o.factor].words} | {o.value:g} |"
        if o.errors is None or o.errors.coverage is None:
            lines.append(f"{start} | | | | | {o.verdict}: {o.words[:160]} |")
            continue
        words = o.verdict + (", quality gate failed" if o.exit_code == GATE_FAILED else "")
        lines.append(
            f"{start} {1e3 * o.errors.mean_m:.1f} mm | {1e3 * o.errors.std_m:.1f} mm | "
            f"{100.0 * o.errors.completeness['0.05']:.1f} % | {100.0 * o.errors.coverage:.1f} % | {o.sigmas:.1f} | "
            f"{words} |"
        )
    return "\n".join(lines)


def draw(path: Path, outcomes: list[Outcome]) -> None:
    """A panel for each factor: mean and std over its steps, and above them the share that the std covers."""
    names = list(dict.fromkeys(o.factor for o in outcomes))
    rows = -(-len(names) // COLUMNS)
    figure = Figure(figsize=(3.0 * COLUMNS, 2.5 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for panel, name in zip(panels, names, strict=False):
        mine = [o for o in outcomes if o.factor == name]
        at = np.arange(len(mine))
        known = [o.errors for o in mine]
        panel.plot(at, [np.nan if e is None else 1e3 * e.std_m for e in known], "o-", color=BLUE, label="std [mm]")
        panel.plot(at, [np.nan if e is None else 1e3 * abs(e.mean_m) for e in known], "s--", color=SOFT, ms=4,
                   label="|mean| [mm]")  # fmt: skip
        panel.set(yscale="log", xticks=at, xticklabels=[f"{o.value:g}" for o in mine], xlim=(-0.5, len(mine) - 0.5))
        panel.set_title(FACTORS[name].words, fontsize=9, color=INK, pad=14)
        for x, o in zip(at, mine, strict=True):
            is_known = o.errors is not None and o.errors.coverage is not None
            text = f"{100.0 * o.errors.coverage:.0f} %" if is_known else "refused"
            colour = INK if o.verdict in ("true", "refused") else RED
            panel.annotate(text, (x, 1.0), xycoords=("data", "axes fraction"), textcoords="offset points",
                           xytext=(0, 3), ha="center", fontsize=7, color=colour)  # fmt: skip
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    panels[0].legend(fontsize=7, frameon=False)
    save(figure, path)


def main() -> None:
    """Run the factors that are asked for, all by default."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("factors", nargs="*", metavar="FACTOR", default=list(FACTORS), help=" ".join(FACTORS))
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--quality", default="standard")
    options = parser.parse_args()
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_stress_"))
    folder.mkdir(parents=True, exist_ok=True)
    outcomes: list[Outcome] = []
    for name in options.factors:
        for value in FACTORS[name].values:
            outcomes.append(measure(name, value, folder, options.quality))
            print(table(outcomes[-1:]).splitlines()[-1], flush=True)  # noqa: T201
            records = [asdict(o) | {"verdict": o.verdict} for o in outcomes]
            (folder / "stress.json").write_text(json.dumps(records, indent=1), encoding="utf-8")
            draw(folder / "stress.png", outcomes)


if __name__ == "__main__":
    main()
