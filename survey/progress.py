"""Progress on the console and in the log of a run: named stages, the share of the run that is done, and the time left.

On a terminal this is one line with a bar, in a notebook one that is written anew; elsewhere, and in the log, a line a
minute. All lines also go to the logger "bathynerf". Together with `survey.commands` the only place that writes to the
console.
"""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from contextvars import ContextVar
from pathlib import Path
from threading import Event, Thread
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, Task, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from survey.words import printable, wrap_for

# Seconds between plain lines, where there is no terminal, and between looks whether one is due.
_LINE_EVERY_S, _TICK_S = 60.0, 5.0
_ANEW_EVERY_S = 0.5  # In a notebook
# Time [s] over which the pace is measured that tells the time left.
_PACE_S = 600.0

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
    """Shows warnings, unless a program has told `logging` where they go; in a notebook notes and progress too."""
    if Console().is_jupyter:
        return Progress()
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
    """A part of a run while it lasts; whoever does the work reports progress to it.

    ``part`` (number, count) is which of equal parts of a stage it is.
    """

    def __init__(self, progress: Progress, name: str, total: float | None, part: tuple[int, int]):
        self.name, self.total, self.done, self.part = name, total, 0.0, part
        self._progress, self._start = progress, progress.now()

    @property
    def seconds(self) -> float:
        """Since the step began [s]."""
        return self._progress.now() - self._start

    @property
    def share(self) -> float:
        """Share of the stage that is done."""
        number, count = self.part
        return (number + (min(self.done / self.total, 1.0) if self.total else 0.0)) / count

    @property
    def title(self) -> str:
        number, count = self.part
        return self.name if count == 1 else f"{self.name}, tile {number + 1} of {count}"

    def advance(self, amount: float = 1.0, *, detail: str = "") -> None:
        """Say that ``amount`` more of the total is done; ``detail`` is a word or number for the lines of a log."""
        self.done += amount
        self._progress.advanced(self, detail)


class Progress:
    """Reports what a run does, to standard error by default, so that results on standard output can be piped.

    ``verbosity`` is -2 for nothing, -1 for warnings alone, 0 for notes and how far the run is, 1 for stages and details
    too. Every line is appended to a log at ``log_path``, so that the log of a resumed run is complete.
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
        self._last_line = now()
        self._steps: list[Step] = []
        # `IPython.display.DisplayHandle` of the line and of the picture in a notebook
        self._cell: Any = None
        self._picture: Any = None
        # One task: the run, or a stage where nothing is expected of the run.
        self._bars = Bars(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TaskProgressColumn(),
            TimeRemainingColumn(),
            TextColumn("left"),
            console=self._console,
            transient=True,
            get_time=now,
            speed_estimate_period=_PACE_S,
        )
        # Expected times [s] of the stages of a run by name, in order, and the shares of those that have begun.
        self._expected: dict[str, float] = {}
        self._shares: dict[str, float] = {}
        if log_path is not None:
            self.log_to(log_path)

    @contextmanager
    def run(self) -> Iterator[None]:
        """A run, of whose stages times are expected."""
        try:
            yield
        finally:
            self._expected, self._shares = {}, {}
            self._forget_task()

    def expect(self, expected_s: Mapping[str, float]) -> None:
        """Expect times [s] of the stages of a run that follow, by name, in order."""
        self._expected = {name: self._expected[name] for name in self._shares if name in self._expected}
        self._expected |= {name: float(seconds) for name, seconds in expected_s.items() if name not in self._shares}
        if (task := self._task) is not None and self._expected:
            # Not by `update`, which would forget the pace.
            task.total = sum(self._expected.values())
            self._bars.update(task.id, completed=self._done_s)

    @property
    def _done_s(self) -> float:
        """Expected time [s] of what is done of the run."""
        return sum(seconds * self._shares.get(name, 0.0) for name, seconds in self._expected.items())

    @property
    def _task(self) -> Task | None:
        return next(iter(self._bars.tasks), None)

    def _forget_task(self) -> None:
        if (task := self._task) is not None:
            self._bars.remove_task(task.id)

    def _begin(self, step: Step) -> None:
        """Count a stage as begun; stages before it that did not begin are left out of the run."""
        if step.name in self._expected:
            names = list(self._expected)
            for name in names[: names.index(step.name)]:
                if name not in self._shares:
                    del self._expected[name]
            self._shares.setdefault(step.name, 0.0)
        total = sum(self._expected.values()) or step.total
        if self._task is None:
            self._bars.add_task(step.title, total=total)
            if self.verbosity >= 0 and self._console.is_jupyter:
                from IPython.display import display

                self._cell = display({"text/plain": f"{step.title} ..."}, raw=True, display_id=True)
        elif self._task.total != total:
            self._task.total = total
        self._show(step)
        self._last_line = self.now()

    def _show(self, step: Step, detail: str = "") -> None:
        """Show how far the run is in an outermost step."""
        if (task := self._task) is None:
            return
        if step.name in self._expected:
            self._shares[step.name] = max(step.share, self._shares[step.name])
        done = self._done_s if self._expected else step.done
        self._bars.update(task.id, completed=done, description=printable(f"{step.title} {detail}".rstrip()))

    def advanced(self, step: Step, detail: str = "") -> None:
        """Take in that a step has advanced."""
        if step is self._steps[0]:
            self._show(step, detail)
        if not self._is_shown:
            self.say_if_due(step, detail)

    @property
    def _is_shown(self) -> bool:
        """Whether a bar shows how far the run is."""
        return self.verbosity >= 0 and self._console.is_terminal

    def say_if_due(self, step: Step, detail: str = "") -> None:
        """Say how far the run is where the last line of it is a minute old, in a notebook half a second."""
        now, task = self.now(), self._task
        if now - self._last_line < (_LINE_EVERY_S if self._cell is None else _ANEW_EVERY_S) or task is None:
            return
        self._last_line = now
        share = f"{task.percentage:.0f} %{' of the run' if self._expected else ''}" if task.total else ""
        left = f"about {rough(task.time_remaining)} left" if task.time_remaining else f"{clock(step.seconds)} so far"
        left = "" if task.finished else left
        text = f"{step.title}: {', '.join(part for part in (share, left, detail) if part)}"
        if self._cell is None:
            self._emit(text)
        else:
            self._cell.update({"text/plain": printable(text)}, raw=True)

    def picture(self, path: Path) -> None:
        """Show a picture in a notebook, in the place of the one before; elsewhere nothing."""
        if self.verbosity < 0 or not self._console.is_jupyter:
            return
        from IPython.display import Image, display

        shown = Image(filename=str(path))
        if self._picture is None:
            self._picture = display(shown, display_id=True)
        else:
            self._picture.update(shown)

    @contextmanager
    def _saying(self) -> Iterator[None]:
        """Let steps that do not advance say how far they are, where there is no terminal."""
        ended = Event()

        def tick() -> None:
            while not ended.wait(_TICK_S):
                # A copy: the thread of the run removes steps that end.
                for step in self._steps[-1:]:
                    self.say_if_due(step)

        Thread(target=tick, daemon=True).start()
        try:
            yield
        finally:
            ended.set()

    def log_to(self, path: Path) -> None:
        """Write every following line to a log file too, whose folder is made where it is missing."""
        self.close()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._log = path.open("a", encoding="utf-8", buffering=1)

    @contextmanager
    def stage(self, name: str, total: float | None = None, *, part: tuple[int, int] = (0, 1)) -> Iterator[Step]:
        """A part of the run, or of a stage; ``total`` in any unit in which `Step.advance` counts.

        ``part`` is its number among equal parts of the stage, and how many these are.
        """
        step, is_outermost = Step(self, name, total, part), not self._steps
        self._steps.append(step)
        if is_outermost:
            self._begin(step)
        if not self._is_shown:
            self._emit(f"{step.title} ...", at_verbosity=1)
        shown: AbstractContextManager[object] = nullcontext()
        if is_outermost:
            shown = self._bars if self._is_shown else self._saying()
        try:
            with shown:
                yield step
            if is_outermost:
                step.done = step.total = step.total or 1.0
                self._show(step)
                if self._cell is not None:
                    self._last_line = -math.inf
                    self.say_if_due(step)
        finally:
            self._steps.remove(step)
            if is_outermost and not self._expected:
                self._forget_task()
        self._emit(f"{step.title}: done in {clock(step.seconds)}", at_verbosity=1)

    def note(self, *texts: str) -> None:
        """Lines that the user should see."""
        for text in texts:
            self._emit(text)

    def detail(self, *texts: str) -> None:
        """Lines for the log, shown with ``-v`` only."""
        for text in map(printable, texts):
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

    def _emit(self, text: str, *, at_verbosity: float = 0) -> None:
        text = printable(text)
        LOGGER.info("%s", text)
        self._line(text, at_verbosity=at_verbosity)

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
