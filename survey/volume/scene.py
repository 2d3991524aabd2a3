"""Training data of a volume, the photographs of a run that look into a box about its bed, and the folder of its state.

The state is saved during training, so that an interrupted one continues, and at its end.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fields.volume.paths import Box
from fields.volume.photographs import Photographs, may_show, pixels_over
from fields.volume.sampling import Cells
from fields.volume.surface import LEAST_VIEWS
from geo.files import reporting_disk_errors, write_whole
from refract import FlatWater
from survey.display.canvas import canvas, save
from survey.errors import OutputError, SurveyError
from survey.export.loaded import LoadedRun, Photograph, at_scale
from survey.files.json_values import read_json_object, write_json
from survey.files.paths import ReadFiles, require_folder
from survey.progress import current
from survey.run.flight import Flight
from survey.run.stored import FIELD_BED, FIELD_CLOUD, FIELD_SETTINGS, FIELD_STATE
from survey.run.trained_field import read_state
from survey.volume.options import VolumeOptions, monocular_priors

# A box reaches over and under the inner part of the heights by a share of their range and some cells.
_INNER, _REACH, _REACH_CELLS = (0.1, 99.9), 0.1, 3.0
_PIXELS_PER_CELL = 2.0  # Photographs are reduced until a cell of the volume is so many pixels wide
# A photograph counts if it shows the box with this share of its pixels.
_LEAST_SHARE = 0.002
REPORT, HELD, VIEWS, CURVE = "report.json", "held out", "views", "training.png"
_EVERY_S, _SHARE = 5.0, 0.05  # Seconds between two states, unless these would take more than a share of the time


@dataclass(frozen=True)
class Scene:
    """Training data of a volume: its box, the run's bed in it, photographs for training and held out."""

    box: Box
    bed: np.ndarray  # (N, 3) [m], local: points of the run inside the box
    # train, held: for training, and held out, with their names
    train: Photographs
    held: Photographs
    pixel_m: float  # [m]: of a photograph, on the bed

    def cells_about_bed(self, num: int, margin: float) -> Cells:
        """The cells of a proxy, ``num`` along the longest edge, within ``margin`` of them about the run's bed."""
        everywhere = Cells.everywhere(self.box, num)
        shape = np.array(everywhere.occupied.shape)
        index = np.minimum(((self.bed - self.box.low) / self.box.size * shape).astype(int), shape - 1)
        filled = np.zeros(tuple(shape), dtype=np.float32)
        filled[tuple(index.T)] = 1.0
        return everywhere.refined(torch.from_numpy(filled.ravel()), 0.5, margin * self.box.edge / num)


class TooFewPhotographs(SurveyError):
    """Fewer photographs show a box than the training of a field needs."""


@dataclass(frozen=True)
class BedBox:
    """A box about the bed of a run, and the scale at which photographs are read for it."""

    box: Box
    bed: np.ndarray  # (N, 3) [m], local: points of the run, in the box or about it
    water: FlatWater | None  # None for a dry survey
    straight: bool  # Rays are not bent
    gsd_m: float  # [m]: of the photographs at full size
    scale: float = 1.0  # of the photographs

    @property
    def pixel_m(self) -> float:
        """A pixel of a photograph at the scale, on the bed [m]."""
        return self.gsd_m / self.scale

    @staticmethod
    def of_run(run: LoadedRun, flight: Flight, options: VolumeOptions) -> BedBox:
        """The box of the whole bed, or of the part in the bounds."""
        bed = flight.frame.local_from_crs(_within(run.columns("points_crs")["points_crs"], options.bounds))
        low, high = np.percentile(bed, _INNER, axis=0)
        bottom, top = _heights_about(bed, float((high - low).max()) / options.cells)
        box = Box(np.append(low[:2], bottom), np.append(high[:2], top))
        ground = BedBox(box, bed, flight.water, options.straight, run.bed_header.gsd_m)
        return ground.read_for(box.edge, options)

    @property
    def bent(self) -> FlatWater | None:
        """The water at which rays are bent; None where they are straight."""
        return None if self.straight else self.water

    def read_for(self, edge: float, options: VolumeOptions) -> BedBox:
        """The same with the scale of photographs that volumes of an edge [m] need."""
        suited = min(1.0, _PIXELS_PER_CELL * self.gsd_m * options.cells / edge)
        return replace(self, scale=options.image_scale or suited)

    def within(self, box: Box, cells: int) -> BedBox | None:
        """The part within a box in plan, with the heights of the bed there; None where there is no bed."""
        part = self.bed[((self.bed[:, :2] > box.low[:2]) & (self.bed[:, :2] < box.high[:2])).all(axis=1)]
        if not len(part):
            return None
        low, high = _heights_about(part, float(box.size[:2].max()) / cells)
        return replace(self, box=Box(np.append(box.low[:2], low), np.append(box.high[:2], high)), bed=part)

    def scene(self, train: Photographs, held: Photographs) -> Scene:
        """Training data: photographs, and the bed in the box."""
        inside = ((self.bed > self.box.low) & (self.bed < self.box.high)).all(axis=1)
        return Scene(self.box, self.bed[inside], train, held, self.pixel_m)


def load_scene(run: LoadedRun, flight: Flight, options: VolumeOptions, advance: Callable[[], object]) -> Scene:
    """The training data of a run, its photographs where they are now; ``advance`` is called after each of them."""
    ground = BedBox.of_run(run, flight, options)
    held = held_photographs(ground, flight, options)
    return ground.scene(training_photographs(ground, flight, options, held, advance), held)


def held_photographs(ground: BedBox, flight: Flight, options: VolumeOptions) -> Photographs:
    """Every so many of the photographs of a flight, from the first on, of which those that show the box count.

    So does nerfstudio with ``eval_mode interval``. Raises SurveyError if photographs are to be held out and none of
    them shows the box.
    """
    if options.held_every is None:
        return _decoded((), ground.bent)
    held = _decoded(_showing(ground, replace(flight, views=flight.views[:: options.held_every])), ground.bent)
    if not held.names:
        raise SurveyError(
            f"none of the photographs 0, {options.held_every}, {2 * options.held_every}, ... shows the box of the "
            "field, so that none is held out; give another --held-every, or larger --bounds"
        )
    return held


def training_photographs(
    ground: BedBox, flight: Flight, options: VolumeOptions, held: Photographs, advance: Callable[[], object]
) -> Photographs:
    """Photographs for training, those that are not held out, with their priors."""
    showing = _showing(ground, flight, advance)
    shown = ((photograph, pixels) for photograph, pixels in showing if photograph.view.name not in held.names)
    learned = _decoded(shown, ground.bent, whole=options.shell)
    if len(learned.names) < LEAST_VIEWS:
        raise TooFewPhotographs(
            f"{len(learned.names)} of {len(flight.views)} photographs show the floor of the box about the bed, "
            f"expected at least {LEAST_VIEWS} for training; give larger --bounds, or a smaller --cells"
        )
    if options.monocular is not None:
        learned.priors = monocular_priors(Path(options.monocular), learned.names, learned.cameras)
    return learned


def _showing(
    ground: BedBox, flight: Flight, advance: Callable[[], object] = lambda: None
) -> Iterator[tuple[Photograph, np.ndarray]]:
    """Photographs that show the box, before they are decoded, with the pixels that do."""
    for photograph in at_scale(flight, ground.scale):
        camera = photograph.camera
        if may_show(camera, ground.box, ground.bent):
            pixels = pixels_over(camera, ground.box, ground.bent)
            if len(pixels) >= _LEAST_SHARE * camera.width * camera.height:
                yield photograph, pixels
        advance()


def _decoded(
    shown: Iterable[tuple[Photograph, np.ndarray]], water: FlatWater | None, *, whole: bool = False
) -> Photographs:
    """Photographs with those of their pixels, or of all (``whole``), that may be used."""
    found, names = Photographs([], [], [], water), []
    for photograph, pixels in shown:
        decoded = photograph.pixels()
        usable = np.ones(decoded.rgb.shape[:2], dtype=bool) if decoded.mask is None else decoded.mask
        found.cameras.append(photograph.camera)
        found.images.append(decoded.rgb)
        found.pixels.append(np.flatnonzero(usable) if whole else pixels[usable.flat[pixels]])
        names.append(photograph.view.name)
    return replace(found, names=tuple(names))


def _within(points: np.ndarray, bounds: tuple[float, float, float, float] | None) -> np.ndarray:
    """The points (N, 3) in bounds (E0, N0, E1, N1)."""
    if bounds is None:
        return points
    e0, n0, e1, n1 = bounds
    inside = (points[:, 0] >= e0) & (points[:, 0] <= e1) & (points[:, 1] >= n0) & (points[:, 1] <= n1)
    if not inside.any():
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        raise SurveyError(
            f"no bed lies in --bounds {e0:.10g} {n0:.10g} {e1:.10g} {n1:.10g}; it reaches from {low[0]:.10g} to "
            f"{high[0]:.10g} east and from {low[1]:.10g} to {high[1]:.10g} north"
        )
    return points[inside]


def _heights_about(bed: np.ndarray, cell: float) -> tuple[float, float]:
    """Lowest and highest place of a box about points (N, 3) whose cells have an edge [m]."""
    low, high = np.percentile(bed[:, 2], _INNER)
    room = _REACH * (high - low) + _REACH_CELLS * cell
    return low - room, high + room


class VolumeFolder:
    """The folder of a volume: all settings that its training depends on, and its state."""

    def __init__(self, path: Path, settings: dict[str, Any], inputs: ReadFiles):
        self.path, self._inputs = path, inputs
        self._events: Any = None  # TensorBoard's writer, once there is something to write
        self._written: int | None = 0  # Moments that it has; None where it cannot write
        self._is_renewed = True  # Whether the folder has no settings and results of fewer steps
        require_folder("-o", path, inputs)
        self._due = time.monotonic() + _EVERY_S
        # As a file would give them back.
        settings = json.loads(json.dumps(settings))
        if (path / FIELD_SETTINGS).is_file():
            before = read_json_object(path / FIELD_SETTINGS)
            self._require_same(before, settings)
            self._is_renewed = before.get("steps") == settings.get("steps")
        elif path.is_dir() and any(path.iterdir()):
            raise OutputError(f"-o names {path}, which is not empty and holds no volume; name another folder")
        with reporting_disk_errors(path):
            path.mkdir(parents=True, exist_ok=True)
        if self._is_renewed:
            write_json(path / FIELD_SETTINGS, settings)
        self._settings = settings

    def part(self, name: str) -> VolumeFolder:
        """Subfolder of a submodule."""
        return VolumeFolder(self.path / name, self._settings | {"part": name}, self._inputs)

    def _require_same(self, before: dict[str, Any], settings: dict[str, Any]) -> None:
        # A run may have been moved, and one field may get more steps.
        more = not settings.get("submodules") and settings.get("steps", 0) >= before.get("steps", 0)
        free = {"run", "steps"} if more else {"run"}
        keys = [key for key in {**before, **settings} if key not in free and before.get(key) != settings.get(key)]
        if "result" in keys:
            raise OutputError(
                f"-o names {self.path}, whose field was trained on another run, or on an earlier result of this one; "
                "name another folder"
            )
        if keys:
            differ = "; ".join(f"{key}: {before.get(key)} there, {settings.get(key)} asked for" for key in keys)
            raise OutputError(f"-o names {self.path}, which holds a volume of other settings ({differ}); name another")

    def load(self) -> dict[str, Any] | None:
        """The state that was saved last; None where there is none."""
        state = self.path / FIELD_STATE
        return read_state(state) if state.is_file() else None

    def save(self, make: Callable[[], dict[str, Any]], *, last: bool) -> None:
        """Save a state, if it is the last or it is time for one."""
        begun = time.monotonic()
        if last or begun >= self._due:
            state = make()
            self._renew()
            with write_whole(self.path / FIELD_STATE) as stream:
                torch.save(state, stream)
            self._follow(state["history"])
            saved = time.monotonic()
            self._due = saved + max(_EVERY_S, (saved - begun) / _SHARE)

    def _renew(self) -> None:
        """Remove what was made of fewer steps before there is a state of more, and write the settings of these."""
        if self._is_renewed:
            return
        with reporting_disk_errors(self.path):
            for name in (REPORT, FIELD_CLOUD):
                (self.path / name).unlink(missing_ok=True)
            for name in (FIELD_BED, HELD, VIEWS):
                shutil.rmtree(self.path / name, ignore_errors=True)
        write_json(self.path / FIELD_SETTINGS, self._settings)
        self._is_renewed = True

    def _follow(self, history: list[tuple[int, float, float | None]]) -> None:
        """Draw the curve of the training, and write the moments that are new for TensorBoard, if it is installed."""
        if history:
            _draw_curve(self.path / CURVE, history)
            current().picture(self.path / CURVE)
        if self._written is None or find_spec("tensorboard") is None:
            return
        try:
            from torch.utils.tensorboard import SummaryWriter

            self._events = self._events or SummaryWriter(str(self.path), purge_step=0)
            for step, *both in history[self._written :]:
                for name, value in zip(("photographs", "held out"), both, strict=True):
                    if value is not None:
                        self._events.add_scalar(f"PSNR [dB]/{name}", value, step)
            self._events.flush()
            self._written = len(history)
        except Exception as error:  # Of a package beside the training, which goes on without it
            current().warn(f"TensorBoard gets no curve of the training: {error}")
            self._written = None


def _draw_curve(path: Path, history: list[tuple[int, float, float | None]]) -> None:
    """Draw the PSNR of a training over its steps: of its photographs, and of those held out."""
    figure, axes = canvas(6.0, 4.0)
    steps, own, held = zip(*history, strict=True)
    axes.plot(steps, own, label="photographs")
    if None not in held:
        axes.plot(steps, held, label="photographs held out")
    axes.set_xlabel("steps")
    axes.set_ylabel("PSNR [dB]")
    axes.legend()
    save(figure, path)
