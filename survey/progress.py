"""Progress on the console and in the log of a run: named stages with the time left.

On a terminal stages are bars; elsewhere, and in the log, they are plain lines with their time. All lines also go to
the logger "bathynerf". Together with `survey.commands` the only place that writes to the console.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from pathlib import Path
from threading import Event, RLock, Thread
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars
from rich.text import Text

from survey.escaping import printable
from survey.forecast import LEAST_SHARE, Forecast, StepForecast
from survey.words import wrap_for

# Seconds between plain lines of one stage, where there is no terminal, and between looks whether one is due.
_LINE_EVERY_S, _TICK_S = 60.0, 5.0

_TIME = "%Y-%m-%d %H:%M:%S"

_CURRENT: ContextVar[Progress] = ContextVar("progress")

# For programs that use bathynerf: notes are INFO, details DEBUG, warnings WARNING. Without a handler of theirs nothing
# is written by it.
LOGGER = logging.getLogger("bathynerf")
LOGGER.addHandler(logging.NullHandler())


def current() -> Progress:
    """The progress of the running command; one that shows only warnings if none was opened."""
    return _CURRENT.get(None) or _unopened()


def _unopened() -> Progress:
    """Shows warnings, unless a program has told `logging` where they go."""
    handlers = (*LOGGER.handlers, *logging.getLogger().handlers)
    is_handled = any(not isinstance(handler, logging.NullHandler) for handler in handlers)
    return Progress(verbosity=-2 if is_handled else -1)


@contextmanager
def opened() -> Iterator[Progress]:
    """The progress of the running command, or one of its own for a block that writes a log."""
    progress = _CURRENT.get(None)
    if progress is not None:
        yield progress
        return
    with _unopened() as progress:
        yield progress


class Step:
    """A part of a run while it lasts; whoever does the work reports progress to it."""

    def __init__(self, progress: Progress, name: str, total: float | None):
        self.name, self.total, self.done = name, total, 0.0
        self._progress = progress
        self._now = progress.now
        self._start = self._last_line = self._now()
        self._step_forecast = StepForecast(self._start)
        self._bars = progress._bars
        self._task = self._bars.add_task(name, total=total, step=self) if self._bars is not None else None

    @property
    def seconds(self) -> float:
        """Since the step began [s]."""
        return self._now() - self._start

    @property
    def is_underway(self) -> bool:
        """Whether enough is done that its own pace predicts better than the stated rates."""
        return self.total is not None and self.done >= LEAST_SHARE * self.total

    @property
    def seconds_left(self) -> float | None:
        """Remaining time of the step [s]; None before estimates agree."""
        with self._progress.lock:
            return self._step_forecast.left_s(self._now(), self.total)

    def advance(self, amount: float = 1.0, *, detail: str = "") -> None:
        """Say that ``amount`` more of the total is done; ``detail`` is a word or number to show beside."""
        self.done += amount
        with self._progress.lock:
            self._step_forecast.advance(self._now(), self.done, self.total)
            self._progress.look_ahead()
        if self._bars is not None and self._task is not None:
            description = printable(f"{self.name}  {detail}" if detail else self.name)
            self._bars.update(self._task, completed=self.done, description=description)
        else:
            self.say_if_due(detail)

    def say_if_due(self, detail: str = "") -> None:
        """Say how far the step is where the last line of it is a minute old."""
        now = self._now()
        if now - self._last_line < _LINE_EVERY_S:
            return
        self._last_line = now
        share = f"{100.0 * min(self.done / self.total, 1.0):3.0f} %" if self.total else ""
        left, of_run = self.seconds_left, self._progress.look_ahead()
        times = (
            f"{clock(left)} left" if left else f"{clock(self.seconds)} so far",
            "" if of_run is None else f"about {rough(of_run)} to the end of the run",
        )
        self._progress._emit(f"{self.name}: {', '.join(part for part in (share, *times, detail) if part)}")


class _Ticking:
    """Lets steps that do not advance say how far they are, where there is no terminal."""

    def __init__(self, progress: Progress):
        self._progress, self._ended = progress, Event()

    def __enter__(self) -> None:
        Thread(target=self._tick, daemon=True).start()

    def __exit__(self, *_exception) -> None:
        self._ended.set()

    def _tick(self) -> None:
        while not self._ended.wait(_TICK_S):
            # A copy: the thread of the run removes steps that end.
            for step in self._progress._steps[-1:]:
                step.say_if_due()


class _TimeLeft(ProgressColumn):
    """The step's own estimate, beside its bar."""

    def render(self, task: Task) -> Text:
        step = task.fields["step"]
        left, of_run = step.seconds_left, step._progress.look_ahead()
        parts = [f"{clock(left)} left"] if left else []
        parts += [] if of_run is None else [f"run: about {rough(of_run)}"]
        return Text(", ".join(parts))


class Progress:
    """Reports what a run does.

    Parameters
    ----------
    verbosity : int
        -2 nothing, -1 only warnings, 0 stages and notes, 1 also details.
    log_path : Path, optional
        Gets every line, details and times included, whatever the verbosity. Appended to, so that the log of a
        resumed run is complete.
    stream : text file, optional
        Default: standard error, so that results on standard output can be piped.

    Attributes
    ----------
    forecast : Forecast or None
        Of the run, whose parts have the names of stages.
    """

    def __init__(
        self,
        *,
        verbosity: int = 0,
        log_path: Path | None = None,
        stream: TextIO | None = None,
        now: Callable[[], float] = time.monotonic,
    ):
        self.verbosity, self.now = verbosity, now
        self._console = Console(file=stream or sys.stderr, highlight=False, markup=False, soft_wrap=True)
        self._log: TextIO | None = None
        self._bars: Bars | None = None
        self._steps: list[Step] = []
        # Estimates are made by threads that show them, too.
        self.lock = RLock()
        self.forecast: Forecast | None = None
        if log_path is not None:
            self.log_to(log_path)

    def log_to(self, path: Path) -> None:
        """Write every following line to a log file too, whose folder is made where it is missing."""
        self.close()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._log = path.open("a", encoding="utf-8", buffering=1)

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Step]:
        """A part of the run, or of a stage; ``total`` in any unit in which `Step.advance` counts."""
        outermost = not self._steps
        ticking: AbstractContextManager[None] = nullcontext()
        if outermost and self.verbosity >= 0 and self._console.is_terminal:
            columns = (
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TimeElapsedColumn(),
                _TimeLeft(),
            )
            self._bars = Bars(*columns, console=self._console, transient=True)
            self._bars.start()
        elif self._bars is None:
            self._emit(f"{name} ...")
            ticking = _Ticking(self) if outermost else ticking
        step = Step(self, name, total)
        self._steps.append(step)
        if outermost and self.forecast is not None:
            with self.lock:
                self.forecast.begin(name, self.now())
        try:
            with ticking:
                yield step
        finally:
            self._steps.remove(step)
            if outermost and self._bars is not None:
                self._bars.stop()
                self._bars = None
        if outermost and self.forecast is not None:
            with self.lock:
                self.forecast.end(name, self.now())
        of_run = self.look_ahead() if outermost else None
        remaining = "" if of_run is None or of_run < _LINE_EVERY_S else f", about {rough(of_run)} to the end of the run"
        self._emit(f"{name}: done in {clock(step.seconds)}{remaining}")

    def look_ahead(self) -> float | None:
        """Time to the end of the run [s]; None where nothing is forecast, or before it is steady.

        Whether it is steady is judged by the times that it was asked for.
        """
        with self.lock:
            if self.forecast is None:
                return None
            of_part = self._steps[0].seconds_left if self._steps else None
            if of_part is None and self._steps and self._steps[0].is_underway:
                return None
            return self.forecast.left_s(self.now(), of_part)

    def note(self, text: str) -> None:
        """A line that the user should see."""
        self._emit(text)

    def detail(self, text: str) -> None:
        """A line for the log, shown with ``-v`` only."""
        text = printable(text)
        LOGGER.debug("%s", text)
        self._line(text, at_verbosity=1)

    def warn(self, text: str) -> None:
        """A line that the user must see."""
        text = printable(text)
        LOGGER.warning("%s", text)
        self._line(f"warning: {text}", at_verbosity=-1)

    def log_only(self, text: str) -> None:
        """A text for the log of the run alone, e.g. a traceback."""
        self._line("\n".join(printable(line) for line in text.splitlines()), at_verbosity=math.inf)

    def close(self) -> None:
        """Close the log."""
        if self._log is not None:
            # A full disk has already raised an error when the line was written.
            with suppress(OSError):
                self._log.close()
            self._log = None

    def __enter__(self) -> Progress:
        """Be what `current` returns until the end of the block, and close the log there."""
        self._token = _CURRENT.set(self)
        return self

    def __exit__(self, *_exception) -> None:
        _CURRENT.reset(self._token)
        self.close()

    def _emit(self, text: str) -> None:
        text = printable(text)
        LOGGER.info("%s", text)
        self._line(text)

    def _line(self, text: str, *, at_verbosity: float = 0) -> None:
        stamped = f"{time.strftime(_TIME)} {text}"
        if self.verbosity >= at_verbosity and not self._console.quiet:
            try:
                self._console.print(wrap_for(text, self._console.file) if self._console.is_terminal else stamped)
            except BrokenPipeError:
                raise
            except OSError:
                # If standard error cannot be written, progress lines are dropped; the run and its log go on.
                self._console.quiet = True
        if self._log is not None:
            self._log.write(f"{stamped}\n")


def shares(step: Step) -> Callable[[float], None]:
    """A function that takes the share done, and advances a step whose total is 1."""

    def report(share: float) -> None:
        step.advance(share - step.done)

    return report


def clock(seconds: float) -> str:
    """A duration for people: 8.2 s, 42 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    minutes, left_over = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {left_over:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def rough(seconds: float) -> str:
    """A duration as estimates have it: 40 seconds, 12 minutes, 2.5 hours."""
    if seconds < 90.0:
        return f"{10 * math.ceil(seconds / 10.0)} seconds"
    if seconds < 5400.0:
        return f"{round(seconds / 60.0)} minutes"
    return f"{seconds / 3600.0:.1f} hours"
