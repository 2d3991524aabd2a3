"""Time, memory and truth of the adjustment of large blocks, with exact matches and noise in place of photographs.

    python benchmarks/bench_block_size.py PHOTOGRAPHS ... [--strip] [--positions 0.3] [--dry | --pycolmap] [-o FILE]

Photographs in parallel strips over a bed under water, or on one line; of each place those within half a footprint, and
four of five find a point. Positions are those of GPS with errors of a known standard deviation; lens, water and poses
are found. Prints parameters, processor time and peak of memory beside what the survey takes, errors of positions over
their stated standard deviations, and the error of the water's level. Each size runs in a process of its own.

With --pycolmap the ground is dry, and pycolmap (Ceres, one thread) adjusts the same tie points with the same positions
beside: once, with a Huber loss; what it is compared with has its rounds, checks and covariance. Both are processor
time, building and solving apart; the ratio is that of the sums.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from survey.adjust.block.observed import CELLS, MATCH, PER_CELL, observed, sizes_of, thinned
from survey.adjust.block.priors import prior_of
from survey.adjust.refine import adjust_survey
from survey.folder.survey import Survey
from survey.plan.choices import gsd_m
from tests.block_survey import pose_errors, survey_of
from tests.drawn_block import DrawnBlock, draw_block

_SPACING, _HEIGHT_M, _DEPTH_M, _POINTS = 0.3, 25.0, 1.5, 30


def drawn(num_views: int, *, strip: bool = False, position_std: float = 0.3, dry: bool) -> tuple[DrawnBlock, Survey]:
    """A block, and the survey that it makes."""
    layout = {"strip": True} if strip else {"spacing": _SPACING}
    block = draw_block(
        5, num_points=_POINTS * num_views, num_views=num_views, nadir_only=True, num_control=0, dry_share=float(dry),
        height=_HEIGHT_M, depth=_DEPTH_M, position_std=(position_std,) * 3, **layout,
    )  # fmt: skip
    survey = survey_of(block)
    return block, replace(survey, water=None, config=replace(survey.config, water=None)) if dry else survey


def warm_up() -> None:
    """Import and compile what the first adjustment does."""
    adjust_survey(survey_of(draw_block(5, num_points=90, num_views=6)), use_windows=False)


def measured(num_views: int, *, strip: bool, position_std: float, dry: bool, by_pycolmap: bool) -> dict:
    """Figures of one block."""
    block, survey = drawn(num_views, strip=strip, position_std=position_std, dry=dry)
    warm_up()
    start = time.process_time()
    _build(survey)
    building = time.process_time() - start
    before, start = _peak_mb(), time.process_time()
    found = adjust_survey(survey, use_windows=False)
    seconds = time.process_time() - start
    errors, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    beside = {}
    if by_pycolmap:
        _, build_s, solve_s = solved_by_pycolmap(survey)
        ratio = seconds / (build_s + solve_s)
        beside = {"pycolmap_build_s": build_s, "pycolmap_solve_s": solve_s, "ratio": ratio}
    return {
        "photographs": num_views,
        "observations": len(found.residuals.view),
        "parameters": len(found.covariance.names),
        "build_s": round(building, 3),
        "solve_s": round(seconds - building, 3),
        "peak_mb": round(_peak_mb() - before),
        "median_position_error_m": round(float(np.median(np.linalg.norm(errors, axis=1))), 4),
        "covered": round(float(np.mean(np.abs(errors) <= 1.96 * found.poses.position_std)), 3),
        "level": None if dry else found.parameter("level_m").verdict,
        **{name: round(value, 3) for name, value in beside.items()},
    }


def _build(survey: Survey) -> None:
    """The problem of a survey, as `adjust_survey` builds it first."""
    prior = prior_of(survey, gsd_m(survey))
    ties = survey.observations.ties
    ties = ties.only(np.isin(ties.point, thinned(ties, sizes_of(survey), CELLS, PER_CELL)))
    seen = observed([(MATCH, ties)], None, survey, prior)
    seen.problem(prior, replace(prior.state, points=seen.ties.start))


def solved_by_pycolmap(survey: Survey) -> tuple[np.ndarray, float, float]:
    """Centres (V, 3) [m] of a dry survey by pycolmap, and processor times [s] in which it builds and solves it."""
    start = time.process_time()
    block, lens, priors = pycolmap.Reconstruction(), survey.views[0].lens, []
    params = [*lens.focal, *(lens[name] for name in ("cx", "cy", "k1", "k2", "p1", "p2"))]
    camera = pycolmap.Camera(camera_id=1, model="OPENCV", width=lens.width, height=lens.height, params=params)
    block.add_camera_with_trivial_rig(camera)
    ties, tracks, config = survey.observations.ties, defaultdict(list), pycolmap.BundleAdjustmentConfig()
    for number, view in enumerate(survey.views):
        rows, rotation = np.flatnonzero(ties.view == number), view.camera.cam_from_local
        image = pycolmap.Image(name=view.name, keypoints=ties.pixel[rows], camera_id=1, image_id=number + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ view.camera.centre)
        block.add_image_with_trivial_frame(image, pose)
        config.add_image(number + 1)
        for place, row in enumerate(rows):
            tracks[int(ties.point[row])].append(pycolmap.TrackElement(number + 1, place))
        given, prior = survey.observations.priors[view.name], pycolmap.PosePrior()
        prior.pose_prior_id, prior.corr_data_id = number + 1, block.image(number + 1).data_id
        prior.position, prior.position_covariance = given.position, np.diag(np.square(given.position_std))
        prior.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
        priors.append(prior)
    for point, elements in sorted(tracks.items()):
        block.add_point3D(ties.start[point], pycolmap.Track(elements))
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    options.ceres.solver_options.num_threads = 1
    of_priors = pycolmap.PosePriorBundleAdjustmentOptions()
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(options, of_priors, config, priors, block)
    built = time.process_time()
    adjuster.solve()
    solved = time.process_time()
    centres = np.array([block.image(number + 1).projection_center() for number in range(len(survey.views))])
    return centres, built - start, solved - built


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def main() -> None:
    """Measure the sizes that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", nargs="+", type=int)
    parser.add_argument("--strip", action="store_true", help="all on one line")
    parser.add_argument("--positions", type=float, default=0.3, metavar="M", help="standard deviation of positions")
    parser.add_argument("--dry", action="store_true", help="without water")
    parser.add_argument("--pycolmap", action="store_true", help="without water, and pycolmap beside")
    parser.add_argument("-o", "--output", type=Path, help="a JSON file of all rows")
    options = parser.parse_args()
    if len(options.photographs) == 1:
        dry = options.dry or options.pycolmap
        row = measured(
            options.photographs[0],
            strip=options.strip,
            position_std=options.positions,
            dry=dry,
            by_pycolmap=options.pycolmap,
        )
        print(json.dumps(row))  # noqa: T201
        return
    rows = []
    for number in options.photographs:
        command = [sys.executable, __file__, str(number), "--positions", str(options.positions)]
        command += ["--strip"] * options.strip + ["--dry"] * options.dry + ["--pycolmap"] * options.pycolmap
        rows.append(json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
        print(json.dumps(rows[-1]), flush=True)  # noqa: T201
        if options.output is not None:
            options.output.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
