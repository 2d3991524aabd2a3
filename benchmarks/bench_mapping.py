"""Which mapper of structure from motion for which number of photographs: time, memory and truth, under water.

    python benchmarks/bench_mapping.py NUMBER ... [--mapper MAPPER ...] [--depth M] [-o FILE]

Photographs in parallel strips over a bed under water, from which exact matches with noise and false ones take the place
of features: pairs are those that the program takes, matches are verified by pycolmap, blocks are placed by GPS
positions good to 3 cm and adjusted with bent rays. Prints processor time and peak of memory of mapping, the photographs
that it placed, and errors of positions and heights of points before the adjustment and after. Each row runs in a
process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from survey.adjust.refine import adjust_survey
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.sfm.block import MatchedPhotographs, reconstruct
from survey.words import Mapper
from tests.drawn_block import DrawnBlock, draw_block
from tests.drawn_matches import survey_of_mapped, write_matches

_SPACING, _HEIGHT_M, _POSITION_STD_M, _DRY = 0.3, 25.0, 0.03, 0.1
MAPPERS = [mapper.value for mapper in Mapper if mapper != Mapper.auto]
# Points of the bed for each photograph, and the share of observations that are far off.
_POINTS, _WRONG = 30, 0.02
# Points nearer than this in plan [m] to a true one are that one.
_SAME_M = 0.2


def drawn(num_views: int, depth: float) -> DrawnBlock:
    """The block of a size."""
    return draw_block(
        5, num_points=_POINTS * num_views, num_views=num_views, nadir_only=True, num_control=0, dry_share=_DRY,
        height=_HEIGHT_M, depth=depth, position_std=(_POSITION_STD_M,) * 3, spacing=_SPACING, wrong=_WRONG,
    )  # fmt: skip


def measured(block: DrawnBlock, work: Path, mapper: str, *, adjusts: bool) -> dict:
    """Figures of one mapper over the matches of a block in a folder."""
    num_views = len(block.cameras)
    before, start = _peak_mb(), time.process_time()
    with tempfile.TemporaryDirectory() as scratch:
        blocks = reconstruct(MatchedPhotographs(work / "database.db", work, Path(scratch), num_views), mapper)
    row = {
        "photographs": num_views,
        "mapper": mapper,
        "seconds": round(time.process_time() - start, 1),
        "peak_mb": round(_peak_mb() - before),
        "blocks": [found.num_reg_images() for found in blocks],
    }
    if not blocks:
        return row
    survey, lens = survey_of_mapped(block, blocks)
    row["focal"] = round(float(lens.focal[0] / block.lens.focal[0]), 4)
    points = survey.observations.ties.start
    row |= {f"{name} before": value for name, value in _errors(block, survey, _poses(survey), points).items()}
    if not adjusts:
        return row
    start = time.process_time()
    try:
        found = adjust_survey(survey, use_windows=False)
    except SurveyError as error:
        return row | {"refused": str(error)}
    row |= _errors(block, survey, (found.poses.centres, found.poses.rotations), found.points)
    return row | {"adjustment_s": round(time.process_time() - start, 1)}


def _poses(survey: Survey) -> tuple[np.ndarray, np.ndarray]:
    cameras = [view.camera for view in survey.views]
    return np.array([camera.centre for camera in cameras]), np.array([camera.cam_from_local for camera in cameras])


def _errors(block: DrawnBlock, survey: Survey, poses: tuple[np.ndarray, np.ndarray], points: np.ndarray) -> dict:
    """Root mean squares and largest of the errors of poses, and mean and std of those of heights of points."""
    known = [int(view.name.split(".")[0]) for view in survey.views]
    away = poses[0] - np.array([block.cameras[k].centre for k in known])
    turned = poses[1] @ np.array([block.cameras[k].cam_from_local for k in known]).transpose(0, 2, 1)
    angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(turned, axis1=1, axis2=2) - 1.0), -1.0, 1.0)))
    distance, nearest = cKDTree(block.points[:, :2]).query(points[:, :2])
    off = (points[:, 2] - block.points[nearest, 2])[distance < _SAME_M]
    off = off[np.abs(off - np.median(off)) < np.quantile(np.abs(off - np.median(off)), 0.95)] if len(off) else off
    return {
        **_of_positions(away),
        "turned_deg": round(float(np.sqrt(np.mean(angle**2))), 4),
        "points": len(points),
        "bed_mean_mm": _mm(off.mean()) if len(off) else None,
        "bed_std_mm": _mm(off.std()) if len(off) else None,
    }


def _of_positions(away: np.ndarray) -> dict:
    rms = np.sqrt(np.mean(away**2, axis=0))
    return {"plan_mm": _mm(np.hypot(rms[0], rms[1])), "up_mm": _mm(rms[2]), "worst_mm": _mm(np.abs(away).max())}


def _mm(metres: float) -> float:
    return round(1e3 * float(metres), 1)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Measure the sizes and mappers that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", nargs="+", help="how many are drawn")
    parser.add_argument("--mapper", nargs="+", choices=MAPPERS, default=MAPPERS)
    parser.add_argument("--depth", type=float, default=3.0, metavar="M", help="of the deepest water; default 3 m")
    parser.add_argument("--matches", type=Path, help="a folder that keeps the matches of each size")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file of all rows")
    parser.add_argument("--without-adjustment", action="store_true", help="mapping alone")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one is not None:
        print(json.dumps(_row(options)))  # noqa: T201
        return
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        for number in options.photographs:
            work = (options.matches or Path(scratch)) / f"{number}_{options.depth:g}"
            work.mkdir(parents=True, exist_ok=True)
            for mapper in options.mapper:
                command = [sys.executable, __file__, number, "--mapper", mapper, "--depth", str(options.depth)]
                command += ["--one", str(work), *(["--without-adjustment"] if options.without_adjustment else [])]
                said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
                rows.append(json.loads(said.splitlines()[-1]))
                print(json.dumps(rows[-1]), flush=True)  # noqa: T201
                if options.output is not None:
                    options.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _row(options: argparse.Namespace) -> dict:
    """The row that this process is for."""
    (number,), (mapper,), work = options.photographs, options.mapper, options.one
    block = drawn(int(number), options.depth)
    if not (work / "done").exists():
        pairs = write_matches(block, work / "database.db")
        (work / "done").write_text(f"{pairs} pairs\n", encoding="utf-8")
    return measured(block, work, mapper, adjusts=not options.without_adjustment)


if __name__ == "__main__":
    main()
