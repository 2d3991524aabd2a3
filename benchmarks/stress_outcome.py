"""The steps of the stress campaign: which of them lied, as a table and as a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from stress_factors import FACTORS

from survey.benchmark.records import Errors
from survey.compare.canvas import save
from survey.display.palette import BLUE, DOUBTFUL, INK, RED, SOFT

# Shares of errors that count as 95 %, and standard deviations that a median may be off by.
LEAST, MOST, MOST_SIGMAS = 0.90, 0.99, 2.6
BAD_INPUT, GATE_FAILED = 2, 3
TRUE, REFUSED, TOO_LARGE = "true", "refused", "std too large"
COLUMNS = 5


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
    """One line of the table of docs/notes/stress.md."""
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
    """The table of docs/notes/stress.md."""
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
