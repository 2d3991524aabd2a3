"""Does any block as it comes from the field end in a traceback, and how good is the result where there is one?

    python benchmarks/bench_real_like.py -o FOLDER [--seed 1] [--count 200] [--by ties|photographs]

Each seed is a block of real_like_blocks.py. By photographs it is drawn, processed by the command line (draft) and its
cloud held against the true bed: half a minute of one core, a minute or two for sixty photographs. By ties, the survey
is read and adjusted with exact matches and noise in place of structure from motion and of windows: some seconds; its
tie points are held against the bed, and `std covers` is that of the coordinates of its cameras. Without --by,
blocks of up to eight photographs and every tenth go by photographs, all others by ties. An outcome is a result, a cloud
that failed the quality gate, a clear error, or a crash. Prints rows of seed, block, by, outcome, points, median
error, rms, what std covers, and time; FOLDER/real_like.json has them, and what it has is not run again. The exit code
is 1 where something crashed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
import traceback
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import laspy
import numpy as np
import pycolmap
from real_like_blocks import LENS, Flight, RealLikeBlock, bed_of, draw_flights, is_inside, name_of
from scipy.spatial.transform import Rotation

from geo.errors import GeoError
from geo.las_header import extra_of
from geo.similarity import Similarity
from refract.lens import distorted
from survey.adjust.refine import adjust_survey
from survey.benchmark.benchmark import run_bathynerf
from survey.errors import PosesError, SurveyError
from survey.folder.survey import Survey, load_survey
from survey.photos.poses import TiePoints, connected_parts, least_track
from survey.sfm import block as sfm_block
from survey.sfm.solve import FreeBlocks, Photographs, aliases
from survey.simulate.ground.shapes import BedGrid

# Points to the square metre, the share of them that each photograph has, and of false ones among these.
_DENSITY, _FOUND, _FALSE = 3.0, 0.75, 0.01
_STD_PX, _FALSE_PX, _START_M = 0.3, 12.0, 0.1
RESULT, GATE_FAILED, REFUSED, CRASHED = "result", "gate failed", "refused", "CRASHED"
_OUTCOMES = {0: RESULT, 3: GATE_FAILED, 2: REFUSED}
TIES, PHOTOGRAPHS = "ties", "photographs"
# By photographs go the small ones and one of so many.
_SMALL, _EVERY = 8, 10
# Heights beyond this [m] are counted apart, as they would be the whole of the rms.
_FAR_M = 1.0


def adjusted_by_ties(block: RealLikeBlock, folder: Path, bed: BedGrid) -> tuple[np.ndarray, float]:
    """Tie points (N, 3) in crs of an adjusted block, and the share of coordinates of cameras that their std covers.

    Raises
    ------
    SurveyError, GeoError
        As reading and adjusting a survey do.
    """
    flight = Flight.of(block.ground)
    taken = block.taken(np.random.default_rng([block.seed, 34]))
    ties = _ties(flight, taken, bed, np.random.default_rng([block.seed, 36]))

    def solve(photographs: Photographs, *_others: object) -> FreeBlocks:
        return _free(ties, taken, flight, aliases(photographs.images), np.random.default_rng([block.seed, 37]))

    again = _ties(flight, taken, bed, np.random.default_rng([block.seed, 38]))

    def windows(survey: Survey, **_others: object) -> TiePoints:
        return _in_survey(again, taken, flight, survey)

    with patch("survey.sfm.poses.solve", solve), patch("survey.adjust.refine.measure_windows", windows):
        found = adjust_survey(survey := load_survey(folder), device="cpu")
    points = survey.frame.crs_from_local(found.points[: len(found.points) - len(found.control)])
    true = {name_of(k): flight.frame.crs_from_local(flight.cameras[k].centre[None])[0] for k in taken}
    off = found.poses.centres - survey.frame.local_from_crs(np.array([true[name] for name in found.poses.names]))
    return points, float(np.mean(np.abs(off) <= 1.96 * found.poses.position_std))


def _ties(flight: Flight, taken: list[int], bed: BedGrid, rng: np.random.Generator) -> TiePoints:
    """Points of the bed that three photographs find, or two of two, in the flight's frame; views as in ``taken``."""
    centres = np.array([flight.cameras[k].centre for k in taken])
    low, high = centres[:, :2].min(axis=0) - 5.0, centres[:, :2].max(axis=0) + 5.0
    places = rng.uniform(low, high, (int(_DENSITY * np.prod(high - low)), 2))
    points = np.column_stack([places, bed.height(*places.T)])
    point, view, pixel = [], [], []
    for number, k in enumerate(taken):
        straight = flight.cameras[k].project(points, flight.water)
        # Distortion is a polynomial: far outside the photograph it would fold points back into it.
        near = (np.abs(straight - (LENS["cx"], LENS["cy"])) < LENS.width).all(axis=1)
        at = np.full_like(straight, np.nan)
        at[near] = distorted(LENS, straight[near])
        seen = np.flatnonzero(is_inside(at) & (rng.random(len(points)) < _FOUND))
        noise = _STD_PX * rng.standard_normal((len(seen), 2))
        noise += (rng.random(len(seen)) < _FALSE)[:, None] * rng.uniform(-_FALSE_PX, _FALSE_PX, (len(seen), 2))
        point.append(seen)
        view.append(np.full(len(seen), number))
        pixel.append(at[seen] + noise)
    columns = [np.concatenate(column) for column in (point, view, pixel)]
    order = np.argsort(columns[0], kind="stable")
    of_all = TiePoints(points, *(column[order] for column in columns))
    return _of_views(of_all, least_track(len(taken)))


def _of_views(ties: TiePoints, least: int) -> TiePoints:
    """The points that so many views have at least."""
    enough = np.bincount(ties.point, minlength=len(ties)) >= least
    keep, number = enough[ties.point], np.cumsum(enough) - 1
    return TiePoints(ties.start[enough], number[ties.point[keep]], ties.view[keep], ties.pixel[keep], least)


def _apparent(points: np.ndarray, flight: Flight) -> np.ndarray:
    """Where straight rays have points (N, 3) of the bed, about."""
    if flight.water is None:
        return points
    apparent = points.copy()
    apparent[:, 2] = np.where(points[:, 2] < 0.0, points[:, 2] / flight.water.n_water, points[:, 2])
    return apparent


def _in_survey(ties: TiePoints, taken: list[int], flight: Flight, survey: Survey) -> TiePoints:
    """The points in the frame of a survey, of its views."""
    number = {view.name: k for k, view in enumerate(survey.views)}
    of_view = np.array([number.get(name_of(k), -1) for k in taken])
    posed = of_view[ties.view] >= 0
    seen = replace(ties, point=ties.point[posed], view=of_view[ties.view[posed]], pixel=ties.pixel[posed])
    kept = _of_views(seen, least_track(len(survey.views)))
    return replace(kept, start=survey.frame.local_from_crs(flight.frame.crs_from_local(kept.start)))


def _free(
    ties: TiePoints, taken: list[int], flight: Flight, alias_of: Mapping[str, str], rng: np.random.Generator
) -> FreeBlocks:
    """The blocks that structure from motion would find, each in a frame of its own."""
    part, least = connected_parts(len(taken), ties.point, ties.view), least_track(len(taken))
    blocks, names = [], list(alias_of.values())
    start = _apparent(ties.start, flight) + _START_M * rng.standard_normal(ties.start.shape)
    for number in range(int(part.max(initial=-1)) + 1):
        mine = np.flatnonzero(part == number)
        if len(mine) >= least:
            blocks.append(_reconstruction(replace(ties, start=start), taken, mine, flight, names))
            turn = Similarity(rng.uniform(0.05, 2.0), Rotation.random(rng=rng).as_matrix(), rng.normal(0.0, 5.0, 3))
            sfm_block.transform(blocks[-1], turn)
    if not blocks:
        raise PosesError(f"structure from motion placed 0 of {len(taken)} images, expected at least {least}")
    return FreeBlocks(tuple(blocks), ())


def _reconstruction(
    ties: TiePoints, taken: list[int], mine: np.ndarray, flight: Flight, names: list[str]
) -> pycolmap.Reconstruction:
    """The photographs ``mine`` of ``taken`` with their points; named as ``names`` has them."""
    block = pycolmap.Reconstruction()
    params = [LENS.focal[0], LENS["cx"], LENS["cy"], LENS["k1"], LENS["k2"]]
    block.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=sfm_block.MODEL, width=LENS.width, height=LENS.height, params=params)
    )
    tracks: dict[int, list[pycolmap.TrackElement]] = {}
    for number in mine.tolist():
        camera, rows = flight.cameras[taken[number]], np.flatnonzero(ties.view == number)
        rotation = camera.cam_from_local
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ camera.centre)
        image = pycolmap.Image(name=names[number], keypoints=ties.pixel[rows], camera_id=1, image_id=number + 1)
        block.add_image_with_trivial_frame(image, pose)
        for place, row in enumerate(rows):
            tracks.setdefault(int(ties.point[row]), []).append(pycolmap.TrackElement(number + 1, place))
    for point, elements in sorted(tracks.items()):
        block.add_point3D(ties.start[point], pycolmap.Track(elements))
    block.update_point_3d_errors()
    return block


def by_of(block: RealLikeBlock) -> str:
    """How a block goes where nobody says it."""
    return PHOTOGRAPHS if block.num_views <= _SMALL or block.seed % _EVERY == 0 else TIES


def by_photographs(block: RealLikeBlock, folder: Path, *, keep: bool) -> dict:
    """What came of a block that the command line has processed: a record for JSON."""
    survey, home = folder / f"block_{block.seed}", folder / "home"
    home.mkdir(parents=True, exist_ok=True)
    block.draw(survey, folder / "flights")
    run = survey / "run"
    code, cost, words = run_bathynerf(["process", str(survey), "-o", str(run), "--quality", "draft"], home)
    outcome = _OUTCOMES.get(code, CRASHED)
    record = {"outcome": outcome, "seconds": round(cost.processor_s, 1)}
    if (run / "cloud.las").is_file():
        las = laspy.read(run / "cloud.las")
        extra = extra_of(las)
        std = np.hypot(extra["std"], np.nan_to_num(extra["std_common"]))
        record |= errors_of(np.stack([las.x, las.y, las.z], axis=-1), block, folder / "flights", std)
    elif outcome == CRASHED:
        record["words"] = (home / "stderr.txt").read_text(encoding="utf-8", errors="replace")[-4000:]
    else:
        record["words"] = words.removeprefix("error: ").replace(f"{survey}/", "")
    if outcome != CRASHED and not keep:
        shutil.rmtree(survey)
    return record


def by_ties(block: RealLikeBlock, folder: Path, *, keep: bool) -> dict:
    """What came of a block that was adjusted with exact matches: a record for JSON."""
    survey, start = folder / f"block_{block.seed}", time.process_time()
    block.draw(survey, folder / "flights", grey=True)
    record: dict = {}
    try:
        points, covered = adjusted_by_ties(block, survey, bed_of(folder / "flights" / block.ground))
        record = {"outcome": RESULT} | errors_of(points, block, folder / "flights") | {"covered": covered}
    except (SurveyError, GeoError) as error:
        record = {"outcome": REFUSED, "words": str(error).replace(f"{survey}/", "")}
    except Exception:
        record = {"outcome": CRASHED, "words": traceback.format_exc()[-4000:]}
    if record["outcome"] != CRASHED and not keep:
        shutil.rmtree(survey)
    return record | {"seconds": round(time.process_time() - start, 1)}


def errors_of(points: np.ndarray, block: RealLikeBlock, flights: Path, std: np.ndarray | None = None) -> dict:
    """Vertical errors of points (N, 3) in crs [m], and the share that their standard deviations (N,) cover."""
    if not len(points):
        return {"words": "no points"}
    local = Flight.of(block.ground).frame.local_from_crs(points)
    error = local[:, 2] - bed_of(flights / block.ground).height(local[:, 0], local[:, 1])
    near = np.abs(error) < _FAR_M
    return {
        "points": len(points),
        "median_m": float(np.median(error)),
        "rms_m": float(np.sqrt(np.mean(error[near] ** 2))) if near.any() else None,
        "far": float(np.mean(~near)),
        "covered": None if std is None else float(np.mean(np.abs(error) <= 1.96 * std)),
    }


def row_of(seed: int, record: dict) -> str:
    """One line of the table."""
    start = f"| {seed} | {RealLikeBlock.of(seed)} | {record['by']} | {record['outcome']}"
    end = f"{record['seconds']:.0f} s |"
    if "points" not in record:
        words = (record["words"].strip().splitlines() or [""])[-1]
        return f"{start}: {words[:200].replace('|', '/')} | | | | | {end}"
    covered = "" if record["covered"] is None else f"{100.0 * record['covered']:.0f} %"
    far = f", {100.0 * record['far']:.1f} % beyond {_FAR_M:g} m" if record["far"] > 0.0005 else ""
    rms = "" if record["rms_m"] is None else f"{1e3 * record['rms_m']:.0f} mm"
    return f"{start} | {record['points']:,} | {1e3 * record['median_m']:.0f} mm | {rms}{far} | {covered} | {end}"


def totals_of(found: dict[str, dict]) -> list[str]:
    """A table of how often each outcome was."""
    counts = Counter((record["by"], record["outcome"]) for record in found.values())
    outcomes = (RESULT, GATE_FAILED, REFUSED, CRASHED)
    lines = [f"| by | blocks | {' | '.join(outcomes)} |", f"|{(2 + len(outcomes)) * '---|'}"]
    for by in (PHOTOGRAPHS, TIES):
        num = sum(record["by"] == by for record in found.values())
        if num:
            lines.append(f"| {by} | {num} | {' | '.join(str(counts[by, name]) for name in outcomes)} |")
    return lines


def main() -> None:
    """Run the seeds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1, help="the first")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--by", choices=(TIES, PHOTOGRAPHS))
    parser.add_argument("--keep", action="store_true", help="the folders of all blocks, not of those that crash alone")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    draw_flights(options.output / "flights")
    path = options.output / "real_like.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    asked = {}
    for seed in range(options.seed, options.seed + options.count):
        block = RealLikeBlock.of(seed)
        by = options.by or by_of(block)
        if f"{seed} {by}" not in found:
            run = by_ties if by == TIES else by_photographs
            found[f"{seed} {by}"] = run(block, options.output, keep=options.keep) | {"by": by}
            path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        asked[str(seed)] = found[f"{seed} {by}"]
        print(row_of(seed, asked[str(seed)]), flush=True)  # noqa: T201
    print("\n".join(totals_of(asked)))  # noqa: T201
    sys.exit(1 if any(record["outcome"] == CRASHED for record in asked.values()) else 0)


if __name__ == "__main__":
    main()
