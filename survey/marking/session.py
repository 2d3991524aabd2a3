"""State of the page of `bathynerf mark` as plain values: points, marks, residuals, and the next photograph."""

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from geo.crs import EARTH_RADIUS_M, height_unit_m, is_geographic
from geo.transformation import lon_lat
from refract import FlatWater
from survey.control.points import GivenPoint
from survey.errors import SurveyError
from survey.marking.geometry import by_gain, crossing, epipolar_curve, poses_to_mark, seen_at, survey_to_mark
from survey.marking.mark_store import GROUND, WATER, MarkStore, Pixel, PointKey
from survey.marking.proposals import Proposal, coded, correlated
from survey.photos.cameras import Intersection, View, intersect
from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.settings.tables import DEFAULT_MARKS_STD_PX
from survey.water.level_observation import CLICK_STD_PX

_Points = Mapping[PointKey, GivenPoint | None]
_Marks = Mapping[PointKey, Mapping[str, Pixel]]
# A mark with a residual beyond this many standard deviations is shown as doubtful.
_MOST_MISS = 3.0
# Of epipolar curves in one photograph: more hide it.
_MOST_CURVES = 6
# Photographs that are proposed.
_MOST_NEXT = 30
# Photographs in which marks are proposed at once: each is decoded.
_MOST_SEARCHED = 12


class MarkingSession:
    """A survey whose photographs are marked.

    Poses are those of `run`, by default of the run in the survey folder, else of the poses file; `points` is a file of
    control points beside those that survey.toml names.
    """

    def __init__(self, folder: Path, *, run: Path | None = None, points: Path | None = None):
        config, self.found = survey_to_mark(folder)
        self.name = config.name or folder.resolve().name
        self.store = MarkStore(config, self.found, points)
        self.images = self.found.images
        posed, note = poses_to_mark(self.found, run)
        self._source = None if posed is None else posed.source
        self._frame = None if posed is None else posed.frame
        self._water = None if posed is None else posed.water
        self._views: Mapping[str, View] = {} if posed is None else posed.views
        self.notes: list[str] = [] if note is None else [note]
        given = config.control.marks_std_px
        self._std_px = {GROUND: DEFAULT_MARKS_STD_PX if given is None else given, WATER: CLICK_STD_PX}
        self._met: dict[tuple, Intersection | None] = {}

    def state(self) -> dict:
        """All points and marks, for the lists of the page."""
        points, marks = self.store.points(), self.store.marks()
        return {
            "name": self.name,
            "is_geographic": is_geographic(self.found.crs),
            "poses": self._source,
            "notes": [*self.notes, *self._moved_note(points, marks)],
            "settings": self.store.settings(),
            "can_undo": self.store.can_undo,
            "photographs": [{"name": name, "size": self.found.headers[name].size_px} for name in self.images],
            "points": [self._point(key, point, marks.get(key, {})) for key, point in sorted(points.items(), key=_rank)],
        }

    def look(self, key: PointKey, image: str) -> dict:
        """A point in a photograph: predicted position, epipolar curves, other points; the next photographs to mark."""
        points, marks = self.store.points(), self.store.marks()
        if key not in points or image not in self.images:
            raise SurveyError(f"there is no point {key.name}, or no photograph {image}; load the page again")
        point, own = points[key], marks.get(key, {})
        common, _ = self._common(points, marks)
        water, place = self._water_of(key), self._place(key, point, own, common)
        view = self._views.get(image)
        predicted = None if place is None or view is None else seen_at(view, place, water)
        others = [(name, own[name]) for name in own if name in self._views and name != image]
        curves = []
        if view is not None:
            for name, pixel in others[:_MOST_CURVES]:
                curve = epipolar_curve(self._views[name], pixel, view, water)
                curves.append({"image": name, "dry": curve.dry.tolist(), "wet": curve.wet.tolist()})
        return {
            "predicted": predicted,
            "curves": curves,
            "others": [] if view is None else self._others(key, view, points, marks, common),
            "next": [name for name in self._next(key, point, place, own, image) if name not in own][:_MOST_NEXT],
        }

    def propose(self, key: PointKey, lock: AbstractContextManager = nullcontext()) -> list[dict]:
        """Marks that are proposed for a point, the most alike first; with its own marks they meet in one place.

        Photographs are decoded and searched outside of the lock, which is that of all other calls.
        """
        with lock:
            points, marks = self.store.points(), self.store.marks()
            point, own = points[key], marks.get(key, {})
            place, water = self._place(key, point, own, self._common(points, marks)[0]), self._water_of(key)
            names = [name for name in self._next(key, point, place, own, None) if name not in own]
        marked = [name for name in own if name in self._views]

        def nearest(name: str) -> tuple[float, str]:
            """Distance of the nearest camera with a mark [m], and its photograph."""
            centre = self._views[name].camera.centre
            return min((float(np.linalg.norm(self._views[one].camera.centre - centre)), one) for one in marked)

        if marked and place is not None:
            names.sort(key=nearest)
        load = lru_cache(len(own) + 1)(self.grey)
        found: dict[str, Proposal] = {}
        for name in names[:_MOST_SEARCHED]:
            view = self._views.get(name)
            near = None if place is None or view is None else seen_at(view, place, water)
            proposal = None
            if key.kind == GROUND:
                proposal = coded(load(name), key.name, None if near is None else np.array(near))
            if proposal is None and place is not None and near is not None and marked:
                like = nearest(name)[1]
                pair, greys = (self._views[like], self._views[name]), (load(like), load(name))
                proposal = correlated(pair, greys, own[like], place, water)
            if proposal is not None:
                found[name] = proposal
        limit = _MOST_MISS * self._std_px[key.kind]
        while (met := self._meet(key, {**own, **{name: each.pixel for name, each in found.items()}})) is not None:
            known = [name for name in (*own, *found) if name in self._views]
            miss = {name: float(np.hypot(*each)) for name, each in zip(known, met.residuals, strict=True)}
            worst = max(found, key=lambda name: miss.get(name, 0.0), default=None)
            if worst is None or miss.get(worst, 0.0) <= limit:
                break
            del found[worst]
        found = dict(sorted(found.items(), key=lambda each: -each[1].score))
        return [{"image": name, "pixel": each.pixel, "score": each.score} for name, each in found.items()]

    def grey(self, image: str) -> np.ndarray:
        """Grey levels of a photograph (height, width) uint8."""
        return cv2.cvtColor(eight_bits(read_rgb(self.images[image])), cv2.COLOR_RGB2GRAY)

    def _others(self, key: PointKey, view: View, points: _Points, marks: _Marks, common: np.ndarray) -> list[dict]:
        """Predicted positions of other points in a photograph that have no mark there."""
        shown = []
        for other, point in points.items():
            own = marks.get(other, {})
            place = None if other == key or view.name in own else self._place(other, point, own, common)
            seen = None if place is None else seen_at(view, place, self._water_of(other))
            if seen is not None:
                shown.append({"kind": other.kind, "name": other.name, "pixel": seen})
        return shown

    def _next(
        self,
        key: PointKey,
        point: GivenPoint | None,
        place: np.ndarray | None,
        own: Mapping[str, Pixel],
        image: str | None,
    ) -> list[str]:
        """Photographs to mark next: by what their marks tell, by the distance of their GPS positions, or in order."""
        if place is not None:
            marked = [self._views[name] for name in own if name in self._views]
            return by_gain(self._views.values(), place, self._water_of(key), marked, self._std_px[key.kind])
        known = {name: header.lat_lon_height for name, header in self.found.headers.items() if header.lat_lon_height}
        if point is None or not known:
            names = list(self.images)
            at = 0 if image is None else names.index(image)
            return [name for name in names[at:] + names[:at] if name != image]
        lon, lat = lon_lat(self.found.crs, np.array([point.place]))[0, :2]
        places = np.radians([(at[1] - lon, at[0] - lat) for at in known.values()])
        distance = EARTH_RADIUS_M * np.hypot(places[:, 0] * np.cos(np.radians(lat)), places[:, 1])
        return [name for _, name in sorted(zip(distance.tolist(), known, strict=True)) if name != image]

    def _point(self, key: PointKey, point: GivenPoint | None, own: Mapping[str, Pixel]) -> dict:
        """A point with its marks: residuals [px], standard deviation and error of their intersection [m]."""
        answer: dict = {
            "kind": key.kind, "name": key.name, "check": point is not None and point.is_check,
            "place": None if point is None else point.place, "marks": own,
            "limit_px": _MOST_MISS * self._std_px[key.kind], "residuals": {},
            "std_m": None, "off_m": None, "level": None, "depth_m": None,
        }  # fmt: skip
        given = self._given(point)
        intersection = self._meet(key, own)
        if given is not None:
            answer["depth_m"] = self._depth(given)
        if intersection is None or self._frame is None:
            return answer
        names = [name for name in own if name in self._views]
        answer["residuals"] = dict(zip(names, intersection.residuals.tolist(), strict=True))
        # Marks that miss by more than they were taken for are worse than that.
        misses = float(np.sum(intersection.residuals**2)) / self._std_px[key.kind] ** 2
        scale = max(misses / (2 * len(names) - 3), 1.0)
        answer["std_m"] = np.sqrt(scale * np.diag(intersection.covariance)).tolist()
        if given is not None:
            answer["off_m"] = (intersection.place - given).tolist()
        if key.kind == WATER:
            height = float(self._frame.crs_from_local(intersection.place)[2])
            answer["level"] = height * height_unit_m(self.found.crs)
        elif given is None:
            answer["depth_m"] = self._depth(intersection.place)
        return answer

    def _water_of(self, key: PointKey) -> FlatWater | None:
        """The water that refracts the rays to a point; None for a point of the waterline."""
        return None if key.kind == WATER else self._water

    def _depth(self, place: np.ndarray) -> float | None:
        """Depth of a place below the water [m]; None above it."""
        if self._water is None:
            return None
        depth = float(self._water.depth(place))
        return depth if depth > 0.0 else None

    def _given(self, point: GivenPoint | None) -> np.ndarray | None:
        """A point by its coordinates (3,), local."""
        if point is None or self._frame is None:
            return None
        local = self._frame.local_from_crs(np.array(point.place))
        return local if np.isfinite(local).all() else None

    def _meet(self, key: PointKey, own: Mapping[str, Pixel]) -> Intersection | None:
        """Intersection of the marks of a point; None without two photographs that determine it."""
        names = [name for name in own if name in self._views]
        if len(names) < 2:
            return None
        asked = (key, *((name, own[name]) for name in names))
        if asked not in self._met:
            stds = np.full(len(names), self._std_px[key.kind])
            cameras = [self._views[name].camera for name in names]
            pixels = np.array([own[name] for name in names])
            self._met[asked] = intersect(cameras, pixels, stds, self._water_of(key))
        return self._met[asked]

    def _place(
        self, key: PointKey, point: GivenPoint | None, own: Mapping[str, Pixel], common: np.ndarray
    ) -> np.ndarray | None:
        """Predicted place of a point (3,), local: where its marks meet, else its coordinates, else on the water."""
        intersection = self._meet(key, own)
        if intersection is not None:
            return intersection.place
        given = self._given(point)
        if given is not None:
            # Poses by GPS alone may be metres off.
            return given + common
        if key.kind == WATER and (water := self._water) is not None:
            return next((crossing(self._views[name], own[name], water) for name in own if name in self._views), None)
        return None

    def _common(self, points: _Points, marks: _Marks) -> tuple[np.ndarray, int]:
        """Median offset (3,) [m], local, of intersected marks from the coordinates of their points; their number."""
        steps = []
        for key, own in marks.items():
            intersection, given = self._meet(key, own), self._given(points.get(key))
            if intersection is not None and given is not None:
                steps.append(intersection.place - given)
        return (np.median(steps, axis=0) if steps else np.zeros(3)), len(steps)

    def _moved_note(self, points: _Points, marks: _Marks) -> list[str]:
        common, num = self._common(points, marks)
        if not num:
            return []
        east, north, up = common.tolist()
        return [
            f"the marks intersect {east:.2f} m east, {north:.2f} m north and {up:.2f} m up of the given coordinates "
            f"(median of {num} points); the predicted positions of the others are shifted by as much"
        ]


def _rank(entry: tuple[PointKey, GivenPoint | None]) -> int:
    """Control points first, then check points, then the waterline."""
    key, point = entry
    return 2 if key.kind == WATER else int(point is not None and point.is_check)
