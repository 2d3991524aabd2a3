"""`change` of three surveys or more: volume and mean height of each against the first, over time, by polygons.

All count in the cells that every survey covers, so that areas are the same. An error that all cells of a survey share
goes into the mean height whole, however many cells there are; that of the first survey shifts all others alike.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from pathlib import Path

import numpy as np

from evaluation.standards import TO_95
from geo.features import cells_inside
from geo.files import reporting_disk_errors, write_text
from survey.change.change import changes_in, polygons_for, require_cells, require_surveys, volume_text
from survey.change.differences import Volume, differences_of
from survey.compare.options import ChangeOptions
from survey.display.quantities import MINUS, length
from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.files.paths import ReadFiles, is_png, require_file, require_folder
from survey.files.toml_table import option_name
from survey.progress import current
from survey.run.folder import RunDir
from survey.words import RUN_FOLDER, figure_text

ALL = "all"
COLUMNS = (
    "area", "survey", "taken", "net_m3", "net_std_m3", "cut_m3", "cut_std_m3", "fill_m3", "fill_std_m3", "mean_m",
    "mean_std_m", "area_m2",
)  # fmt: skip
TABLE, PICTURE = "series.csv", "series.png"
_OF_TWO = ("json_path", "tif_path", "picture_path")
_SIZE_IN = (8.0, 6.0)


@dataclass(frozen=True)
class Epoch:
    """A survey of a series in one area, against the first survey."""

    area: str  # Name of the polygon, or `ALL`
    survey: Path
    taken: datetime | None  # When its first photograph was taken; None where the run does not know, and of clouds
    net: Volume
    cut: Volume
    fill: Volume

    @property
    def mean_m(self) -> float:
        """Mean difference of the heights [m]."""
        return self.net.volume_m3 / self.net.area_m2

    @property
    def mean_std_m(self) -> float:
        """Its standard deviation [m]."""
        return self.net.std_m3 / self.net.area_m2


def change_series(
    surveys: Sequence[str | Path], output: str | Path | None = None, options: ChangeOptions = ChangeOptions()
) -> list[Epoch]:
    """Changes of three or more surveys, runs or clouds in the order of time, against the first, the earliest.

    Area by area; in each the surveys after the first. Each polygon of the area of the options is one of its own, beside
    all of them. The output is a folder for series.csv and series.png. Raises SurveyError or GeoError as
    `change_between`, and where an option is for two surveys alone.
    """
    paths, folder = [Path(survey) for survey in surveys], None if output is None else Path(output)
    for field in fields(options):
        if field.name in _OF_TWO and getattr(options, field.name) is not None:
            raise SurveyError(
                f"{option_name(field)} shows two surveys, and {len(paths)} are given; give -o DIR instead"
            )
    files = require_surveys(paths, options)
    if folder is not None:
        read, head = ReadFiles.of(*files.values(), options.area, options.stable), ",".join(COLUMNS).encode()
        require_folder("-o", folder, read)
        if folder.is_dir():
            require_file("-o", folder / TABLE, read, kind="a series", is_of_kind=lambda found: found.startswith(head))
            require_file("-o", folder / PICTURE, read, kind="a PNG", is_of_kind=is_png)
    with current().stage("Reading"):
        differences, cells, notes = differences_of(files, options)
        known = np.logical_and.reduce([each.is_known for each in differences])
        areas = {ALL: known}
        if options.area is not None:
            polygons = polygons_for(options.area, cells)
            areas[ALL] = known & cells_inside(polygons.values(), cells)
            if len(polygons) > 1:
                areas |= {name: known & cells_inside([polygon], cells) for name, polygon in polygons.items()}
    require_cells(areas[ALL], options)
    areas = {name: inside for name, inside in areas.items() if inside.any()}
    changes = [changes_in(list(areas.values()), each, cells, options) for each in differences]
    current().note(*dict.fromkeys([*notes, *(note for of_survey in changes for note in of_survey[0].notes)]))
    epochs = [
        Epoch(name, path, taken_of(path), of_survey[number].net, of_survey[number].cut, of_survey[number].fill)
        for number, name in enumerate(areas)
        for path, of_survey in zip(paths[1:], changes, strict=True)
    ]
    if folder is not None:
        with reporting_disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        _write_table(folder / TABLE, epochs)
        _draw(folder / PICTURE, paths[0], epochs)
    return epochs


def taken_of(survey: Path) -> datetime | None:
    """When the first photograph of a run was taken; None where its report does not know."""
    taken = read_json_object(RunDir(survey).report_json_path).get("taken") or {}
    try:
        return datetime.fromisoformat(taken["first"])
    except (KeyError, TypeError, ValueError):
        return None


def rows_of_series(epochs: Sequence[Epoch]) -> list[tuple[str, str]]:
    """Surveys of one area and what changed, in words."""
    return [
        (
            str(epoch.survey) if epoch.taken is None else f"{epoch.taken:%Y-%m-%d} {epoch.survey}",
            f"net {volume_text(epoch.net)}, mean height {'+' if epoch.mean_m > 0.0 else ''}"
            f"{length(epoch.mean_m).replace('-', MINUS)} ± {length(TO_95 * epoch.mean_std_m)}",
        )
        for epoch in epochs
    ]


def _write_table(path: Path, epochs: Sequence[Epoch]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for epoch in epochs:
        volumes = [
            value for volume in (epoch.net, epoch.cut, epoch.fill) for value in (volume.volume_m3, volume.std_m3)
        ]
        taken = "" if epoch.taken is None else epoch.taken.isoformat()
        means = f"{epoch.mean_m:.5f}", f"{epoch.mean_std_m:.5f}"
        texts = [f"{value:.6g}" for value in volumes]
        writer.writerow([epoch.area, epoch.survey, taken, *texts, *means, f"{epoch.net.area_m2:.6g}"])
    write_text(path, text.getvalue())


def _name_of(survey: Path) -> str:
    """A short name: that of the survey of a run, or of a file."""
    return (survey.resolve().parent if survey.name == RUN_FOLDER else survey).name[-30:]


def _draw(path: Path, first: Path, epochs: Sequence[Epoch]) -> None:
    """Volume and mean height over time, with intervals of 95 %; by their order where a date is not known."""
    from survey.display.canvas import empty_figure, save, write_title
    from survey.display.palette import INK, SOFT

    by_area: dict[str, list[Epoch]] = {}
    for epoch in epochs:
        by_area.setdefault(epoch.area, []).append(epoch)
    surveys = [first, *(epoch.survey for epoch in by_area[ALL])]
    dates = [taken_of(first), *(epoch.taken for epoch in by_area[ALL])]
    is_dated = None not in dates
    times = np.array(dates) if is_dated else np.arange(len(surveys))
    figure = empty_figure(*_SIZE_IN)
    upper, lower = figure.subplots(2, sharex=True)
    for area, of_area in by_area.items():
        volumes = [(epoch.net.volume_m3, epoch.net.std_m3) for epoch in of_area]
        means = [(epoch.mean_m, epoch.mean_std_m) for epoch in of_area]
        for axes, values in ((upper, volumes), (lower, means)):
            value, std = np.array([(0.0, 0.0), *values]).T
            axes.errorbar(times, value, yerr=TO_95 * std, marker="o", ms=4, lw=1.2, capsize=3, label=figure_text(area))
    for axes, label in ((upper, "net volume [m³]"), (lower, "mean height [m]")):
        axes.axhline(0.0, color=SOFT, lw=0.8)
        axes.set_ylabel(label, color=INK)
        axes.spines[["top", "right"]].set_visible(False)
    if is_dated:
        lower.set_xlabel("date of flight", color=INK)
    else:
        lower.set_xticks(times, [figure_text(_name_of(survey)) for survey in surveys])
    if len(by_area) > 1:
        upper.legend(frameon=False)
    write_title(upper, "Change of the bed", figure_text(f"against {_name_of(first)}; bars: 95 %"))
    figure.autofmt_xdate()
    save(figure, path)
