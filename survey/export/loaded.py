"""A finished run, its parts and its photographs loaded on first use."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import cv2
import numpy as np
from pyproj import CRS

from geo.compatibility import Reprojection
from geo.las import WITHHELD_STD_M, classes_of, is_withheld
from refract import PinholeCamera
from survey.adjust.result.adjustment import read_adjustment
from survey.errors import SurveyError
from survey.files.json_values import read_json_object
from survey.photos.cameras import View
from survey.photos.images import load_image, load_mask
from survey.progress import current
from survey.run.edits import DELETED, edits_of
from survey.run.flight import Flight, load_flight
from survey.run.folder import RunDir
from survey.run.stored import BED_FILE, FIELD_BED, BedHeader, StoredBed, load_bed, load_bed_columns, load_bed_header
from survey.settings.config import SurveyConfig, read_config
from survey.settings.tables import per_axis
from survey.stage_key import content_hash, stage_key

# The stage whose folder holds the cloud.
BED_STAGE = "bed"

_Made = TypeVar("_Made")


class LoadedRun:
    """The result in a run folder, for use in a ``with`` block, which removes temporary files at its end.

    `stages` are the names of the stages and their folders, which end in a hash of all that the stage depends on. The
    points are those of the bed that edits (`survey.run.edits`) have left; all of them where it is to be as computed;
    or those of the surface of a field that was trained on the run, where its folder is given.
    """

    def __init__(self, path: str | Path, *, as_computed: bool = False, field: Path | None = None):
        self.folder = RunDir(path)
        self.folder.require_run()
        self._bed_folder = self.folder.load_stage(BED_STAGE)
        self.stages: dict[str, str] = self.folder.result()["stages"]
        self.is_field, self.points_path = field is not None, field or self.folder.path
        self.edits = None if as_computed or self.is_field else edits_of(self.folder)
        if field is not None:
            self._bed_folder = field / FIELD_BED
            if not (points := self._bed_folder / BED_FILE).is_file():
                raise SurveyError(f"the field in {field} has no points yet; give its options to bathynerf field again")
            self.stages = self.stages | {FIELD_BED: content_hash(points)}
        self._made: dict[Hashable, Any] = {}
        self._held = ExitStack()

    def __enter__(self) -> LoadedRun:
        return self

    def __exit__(self, *exception) -> None:
        self._made.clear()
        self._held.close()

    @cached_property
    def _whole(self) -> StoredBed:
        return load_bed(self._bed_folder)

    @cached_property
    def bed(self) -> StoredBed:
        """The points of the bed, in the CRS of the survey."""
        return self._whole if self.edits is None else self._whole[self.edits.is_bed]

    def classified_in(self, crs: str | None) -> tuple[StoredBed, np.ndarray]:
        """All points that are not deleted, in a CRS as of `bed_in`, with their classes (N,) uint8 of LAS."""
        if self.edits is None:
            return self.bed_in(crs), classes_of(self.bed.bed.wet)
        kept = self.edits.classes != DELETED
        return self._in(crs, self._whole[kept]), self.edits.classes[kept]

    @cached_property
    def bed_header(self) -> BedHeader:
        """CRS, name and ground sampling distance, without the points."""
        return load_bed_header(self._bed_folder)

    def require_points(self) -> None:
        """Raise SurveyError where the run found no point of the bed."""
        if not len(self.columns("std")["std"]):
            raise SurveyError(
                f"the run {self.folder.path} has no point of the bed, of which products are made; see its report for "
                "what the photographs lack"
            )

    @cached_property
    def certain_bed(self) -> StoredBed:
        """The cloud without the points that LAS flags as withheld; a warning counts them, once for a command."""
        bed = self.bed
        withheld = is_withheld(bed.bed.std)
        if not withheld.any():
            return bed
        if withheld.all():
            raise SurveyError(
                f"all {len(withheld)} points have a standard deviation over {WITHHELD_STD_M:g} m, which LAS flags as "
                "withheld; export LAS, LAZ or PLY, which mark them"
            )
        current().warn(
            f"{int(withheld.sum())} of {len(withheld)} points are left out of products that have no place for a flag: "
            f"their standard deviation is over {WITHHELD_STD_M:g} m, and LAS has them as withheld"
        )
        return bed[~withheld]

    @cached_property
    def flight(self) -> Flight:
        """Cameras, water and local frame; see `survey.run.flight`."""
        return load_flight(self.folder.path)

    @cached_property
    def scratch(self) -> Path:
        """A folder for intermediate results that are larger than the memory; it goes with the run."""
        return Path(self._held.enter_context(TemporaryDirectory(prefix="bathynerf-export-")))

    def columns(self, *names: str) -> dict[str, np.ndarray]:
        """Some columns of the points; see `survey.run.stored.load_bed_columns`."""
        found = load_bed_columns(self._bed_folder, *names)
        return found if self.edits is None else {name: values[self.edits.is_bed] for name, values in found.items()}

    def transformation_to(self, crs: str) -> Reprojection:
        """Transformation from the CRS of the survey to another one; see `geo.compatibility.Reprojection`."""
        # One place of the survey restricts the choice of the operation to those that hold there.
        place, own = self._some_place, self.bed_header.crs
        return self.once(("crs", crs), lambda: Reprojection.between(own, crs, where="--crs", places=place))

    def in_crs(self, points: np.ndarray, crs: str | None) -> np.ndarray:
        """Points (N, 3) in the CRS of the survey in another one; None leaves them."""
        return points if crs is None else self.transformation_to(crs)(points)

    def crs_for(self, crs: str | None) -> CRS:
        """The CRS of products: another one, or None for that of the survey."""
        return self.bed_header.crs if crs is None else self.transformation_to(crs).crs

    def bed_in(self, crs: str | None, *, certain: bool = False) -> StoredBed:
        """The cloud, or `certain_bed`, with its coordinates in another CRS; None for that of the survey."""
        return self._in(crs, self.certain_bed if certain else self.bed)

    def _in(self, crs: str | None, bed: StoredBed) -> StoredBed:
        return bed if crs is None else replace(bed, points_crs=self.in_crs(bed.points_crs, crs), crs=self.crs_for(crs))

    @property
    def _some_place(self) -> np.ndarray:
        return np.asarray(self.columns("points_crs")["points_crs"][:1])

    def some_place_in(self, crs: str | None) -> np.ndarray:
        """A point (1, 3) of the bed, in a CRS, or in that of the survey."""
        return self.in_crs(self._some_place, crs)

    @property
    def is_dry(self) -> bool:
        """Whether no point has a depth."""
        return not np.isfinite(self.columns("depth")["depth"]).any()

    def once(self, key: Hashable, make: Callable[[], _Made]) -> _Made:
        """Result of ``make``, computed once for a key, for several products of one command."""
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]

    @cached_property
    def config(self) -> SurveyConfig:
        """The settings that took effect."""
        return read_config(self.folder.settings_path)

    @cached_property
    def is_true_colour(self) -> bool:
        """Whether points have the colour of the bed without its water."""
        parts = read_json_object(self._bed_folder / "stage.json").get("parts") or {}
        return parts.get("true_colour", stage_key(None)) != stage_key(None)

    @cached_property
    def plan_std_m(self) -> float:
        """Standard deviation along each axis in plan of where the cameras are [m].

        That of an adjustment, else what survey.toml says of the positions, else 0: they were taken as exact.
        """
        if (self.folder.path / "adjustment.json").is_file():
            return float(read_adjustment(self.folder.path).poses.position_std[:, :2].max(axis=1).mean())
        given = self.config.cameras.position_std_m
        return 0.0 if given is None else float(max(per_axis(given)[:2]))

    @cached_property
    def common_std_m(self) -> float:
        """Standard deviation of the height that all points share, by water, lens and poses [m].

        0 where poses and water were taken as exact, as the report says.
        """
        adjustment = read_json_object(self.folder.report_json_path).get("adjustment") or {}
        common = adjustment.get("height_std_common_m") or {}
        return float(common.get("typical") or 0.0)


@dataclass(frozen=True)
class Photograph:
    view: View
    camera: PinholeCamera  # At the scale
    scale: float  # [-]: at most 1

    def pixels(self) -> Pixels:
        """The photograph, decoded."""
        return Pixels(load_image(self.view, scale=self.scale), load_mask(self.view, scale=self.scale))


@dataclass(frozen=True)
class Pixels:
    """A decoded photograph."""

    rgb: np.ndarray  # (height, width, 3) uint8
    mask: np.ndarray | None  # (height, width) bool or None: where it may be used; None for everywhere

    def at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Colours (rows, columns, 3) float64, 0 to 255, at places [px]; NaN where these are NaN or masked."""
        seen = np.isfinite(u)
        # OpenCV counts from the centre of the first pixel.
        x, y = (np.where(seen, place, 0.0).astype(np.float32) - np.float32(0.5) for place in (u, v))
        colour = cv2.remap(self.rgb, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.float64)
        if self.mask is not None:
            height, width = self.mask.shape
            rows, columns = (np.clip(np.round(at), 0, n - 1).astype(np.int64) for at, n in ((y, height), (x, width)))
            seen = seen & self.mask[rows, columns]
        return np.where(seen[..., None], colour, np.nan)


def at_scale(flight: Flight, scale: float) -> list[Photograph]:
    """The photographs of a flight at a scale of at most 1."""
    return [Photograph(v, v.camera if scale == 1.0 else v.camera.scaled(scale), scale) for v in flight.views]


def colours_without_water(run: LoadedRun) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None:
    """Colours (N, 3), 0 to 255, without the water, by depth (N,) [m] and incidence (N,) [rad] in air.

    None where the run's own points have the colours that photographs show.
    """
    water = run.config.water
    if not run.is_true_colour or water is None or water.refractive_index is None:
        return None
    # Imported where they are needed: they take torch.
    from fields.colour.true_colour import stored_colours, without_water
    from fields.water_column import WaterColumn

    column, n_water = WaterColumn(water.absorption_per_m, water.veiling_light), water.refractive_index
    return lambda rgb, depth, incidence: stored_colours(without_water(rgb, depth, incidence, n_water, column))


def flight_of(run: LoadedRun, folder: str | None) -> Flight:
    """The flight as the run used it, its photographs where they are now if the folder of the survey is named."""
    views = run.flight.views
    if folder is not None:
        views = tuple(_elsewhere(view, Path(folder), run.config.images.local_dir) for view in views)
    owner = run.folder.owner()
    for view in views:
        if not view.path.is_file():
            raise SurveyError(
                f"the photograph {view.path} is not there any more; name the folder of the survey with --survey DIR"
            )
        if owner is not None:
            owner.require_unchanged(view.name, view.path)
    return replace(run.flight, views=views)


def survey_folder(run: LoadedRun, folder: str | None) -> Path:
    """The folder of a run's survey: the one that is named, or where it lay when the run was made."""
    if folder is not None:
        return Path(folder)
    images = run.config.images.local_dir
    if Path(images).is_absolute():
        raise SurveyError(f"the photographs lie in {images}, apart from the survey; name its folder with --survey DIR")
    return _folder_of(run.flight.views[0], images)


def _folder_of(view: View, images: str) -> Path:
    return view.path.parents[len(Path(images, view.name).parts) - 1]


def _elsewhere(view: View, folder: Path, images: str) -> View:
    """A view whose survey folder lies elsewhere now."""
    before, mask = _folder_of(view, images), view.mask_path
    if mask is not None and mask.is_relative_to(before):
        mask = folder / mask.relative_to(before)
    return replace(view, path=folder / images / view.name, mask_path=mask)
