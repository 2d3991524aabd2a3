"""How often does the check of given water and lens raise a false alarm, and how often does it see what is wrong?

    python benchmarks/given_alarms.py FOLDER [--seeds 0-59] [--field FOLDER] [--exact SURVEY ...]

Draws a small survey for each seed into FOLDER (random depth, lens, flight, noise, index, waves in a third, poses off by
1 or 2 mm and as many millidegrees in two thirds), takes the windows of the sample that `bathynerf process` looks at,
and asks them about the true water and lens, and about wrong ones. --field takes the surveys that field_surveys.py drew,
with their true poses, lens and water, too; --exact any others that were drawn. Windows are measured under what is true,
and points adjusted anew under what is wrong. Appends to alarms.json in FOLDER, and goes on there where it was stopped.
"""

import argparse
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from field_surveys import _seeds
from PIL import Image
from scipy.spatial.transform import Rotation
from scipy.stats import beta
from stress_factors import with_waves

from survey.adjust import pose_check
from survey.adjust.block.observed import WINDOW
from survey.adjust.block.windows import load_photographs, measure_loaded_windows
from survey.errors import SurveyError
from survey.folder.local_frame import water_plane
from survey.folder.survey import Survey, load_survey
from survey.photos.poses import TiePoints
from survey.plan.plan import Plan, make_plan
from survey.simulate.drawn import DrawnScene, stage_drawing
from survey.simulate.sidecars import cameras_csv, survey_toml

RESULTS = "alarms.json"
TRUE = ("true", 0.0)
# What is wrong, one thing at a time: metres, shares of the focal length, k1.
WRONG = (
    *(("level", error) for error in (0.05, 0.1, 0.2, 0.5)),
    *(("index", error) for error in (0.005, 0.01)),
    *(("focal", error) for error in (0.002, 0.01)),
    ("k1", 0.05),
)
ERRORS_MM = (0.0, 1.0, 2.0)


def scene_of(seed: int) -> tuple[DrawnScene, float]:
    """A small survey, and the amplitude of its waves [m]."""
    rng = np.random.default_rng([seed, 77])
    flying = rng.uniform(8.0, 25.0)
    wide = 0.39 * flying * rng.uniform(0.8, 1.3)
    return DrawnScene(
        size_m=(wide, 0.9 * wide),
        depth_m=rng.uniform(0.5, 0.3 * flying),
        n_water=rng.uniform(1.325, 1.345),
        num_views=int(rng.integers(12, 25)),
        nadir_share=rng.uniform(0.0, 1.0),
        image_px=(320, 240),
        focal_px=rng.uniform(300.0, 650.0),
        flying_m=flying,
        noise=rng.uniform(0.5, 4.0),
        seed=seed,
        shore=bool(rng.random() < 0.3),
        objects=bool(rng.random() < 0.5),
        cell_m=0.025 * flying / 14.0,
        texel_m=0.01 * flying / 14.0,
    ), float(rng.uniform(0.002, 0.012) if rng.random() < 1.0 / 3.0 else 0.0)


def drawn(seed: int, folder: Path) -> Survey:
    """The survey of a seed; errors of poses are of each third in turn."""
    scene, waves = scene_of(seed)
    staged = with_waves(stage_drawing(scene), waves) if waves else stage_drawing(scene)
    shutil.rmtree(folder, ignore_errors=True)
    (folder / "images").mkdir(parents=True)
    # Without the truth beside them, which takes most of the time.
    (folder / "survey.toml").write_text(survey_toml(staged), encoding="utf-8")
    (folder / "cameras.csv").write_text(cameras_csv(staged.names, staged.cameras, staged.frame), encoding="utf-8")
    for number, name in enumerate(staged.names):
        Image.fromarray(staged.photograph(number)).save(folder / "images" / name, quality=95, subsampling=0)
    return with_errors(load_survey(folder), seed)


def with_errors(survey: Survey, number: int) -> Survey:
    """The survey with errors of its poses: of each third of the numbers in turn."""
    error, rng, views = 1e-3 * ERRORS_MM[number % 3], np.random.default_rng([number, 78]), []
    for view in survey.views:
        turn = Rotation.from_rotvec(np.radians(error) * rng.standard_normal(3)).as_matrix()
        moved = {"centre": view.camera.centre + error * rng.standard_normal(3)}
        views.append(
            replace(view, camera=replace(view.camera, **moved, cam_from_local=turn @ view.camera.cam_from_local))
        )
    return replace(survey, views=tuple(views))


def field(source: Path, folder: Path) -> Survey:
    """A field survey with all that is true."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "images").symlink_to((source / "images").resolve())
    for name in ("survey.toml", "cameras.csv"):
        shutil.copy(source / "truth" / name, folder / name)
    return load_survey(folder)


def sample_of(survey: Survey) -> tuple[Survey, Plan, TiePoints]:
    """What `bathynerf process` would look at, and its windows."""
    plan = make_plan(survey)
    block, bound = load_photographs(survey, plan)
    chosen = pose_check._of_middle(survey, plan.height_m)
    unposed = replace(survey, observations=replace(survey.observations, ties=None))
    sample = replace(unposed, views=tuple(survey.views[i] for i in chosen))
    return (
        sample,
        plan,
        measure_loaded_windows(sample, plan, block.part(chosen), bound, lambda _amount: None, sparse=True),
    )


def spoilt(survey: Survey, kind: str, error: float) -> Survey:
    """The survey with something wrong."""
    if kind in ("level", "index"):
        water = survey.require_water()[1]
        name = "level_m" if kind == "level" else "refractive_index"
        water = replace(water, **{name: getattr(water, name) + error})
        return replace(survey, water=water_plane(survey.frame, water), config=replace(survey.config, water=water))
    views = []
    for view in survey.views:
        lens = view.lens
        fx, fy, cx, cy, *others = (*lens.focal, lens["cx"], lens["cy"], lens["k1"], lens["k2"], lens["p1"], lens["p2"])
        if kind == "focal":
            fx, fy = (1.0 + error) * fx, (1.0 + error) * fy
        elif kind == "k1":
            others[0] += error
        lens = replace(lens, model="OPENCV", params=(fx, fy, cx, cy, *others))
        camera = replace(lens.camera(view.camera.centre, view.camera.cam_from_local), tide=view.camera.tide)
        views.append(replace(view, lens=lens, camera=camera))
    return replace(survey, views=tuple(views))


def asked(name: str, survey: Survey) -> dict:
    """What the sample says of the truth, and of what is wrong."""
    sample, plan, windows = sample_of(survey)
    rows = []
    for kind, error in (TRUE, *WRONG):
        # As often too high as too low.
        error *= 1 if len(name) + sum(map(ord, name)) & 1 else -1
        found = pose_check.check_of_ties(spoilt(sample, kind, error) if error else sample, plan, WINDOW, windows)
        told = [[each.name, each.difference, each.std, each.given_std] for each in found.tests]
        doubt = None if found.contradiction is None else found.contradiction.name
        rows.append({"kind": kind, "error": error, "misfit_px": found.misfit_px, "contradiction": doubt, "told": told})
    return {"name": name, "views": len(survey.views), "rows": rows}


def surveys(options: argparse.Namespace, known: set[str]) -> Iterator[tuple[str, Survey]]:
    work = options.folder / "survey"
    for number, source in enumerate(options.exact):
        if f"exact {source.name}" not in known:
            yield f"exact {source.name}", with_errors(load_survey(source), number)
    for seed in options.seeds:
        if f"drawn {seed}" not in known:
            yield f"drawn {seed}", drawn(seed, work)
    for source in sorted(options.field.iterdir()) if options.field else ():
        if f"field {source.name}" not in known and (source / "truth" / "survey.toml").is_file():
            yield f"field {source.name}", field(source, work)


def interval(count: int, number: int) -> str:
    """A share with its 95 % interval (Clopper and Pearson)."""
    low = 0.0 if count == 0 else float(beta.ppf(0.025, count, number - count + 1))
    high = 1.0 if count == number else float(beta.ppf(0.975, count + 1, number - count))
    return f"{count} of {number} ({100.0 * low:.0f} to {100.0 * high:.0f} %)"


def table(records: list[dict]) -> str:
    """How often each error is named, taken for another, or sent to the adjustment by the misfit."""
    lines = ["| off | named | another named | misfit beyond 0.1 px |", "|---|---|---|---|"]
    own = {"level": "level_m", "index": "refractive_index", "focal": "camera0.f", "k1": "camera0.k1"}
    for kind, error in (TRUE, *WRONG):
        rows = [r for record in records for r in record["rows"] if r["kind"] == kind and abs(r["error"]) == error]
        rows = [row for row in rows if row["misfit_px"] is not None]
        named = sum(row["contradiction"] == own.get(kind) for row in rows if row["contradiction"] is not None)
        other = sum(row["contradiction"] not in (None, own.get(kind)) for row in rows)
        missed = sum(row["contradiction"] is None and row["misfit_px"] > pose_check.MOST_MISFIT_PX for row in rows)
        counts = [interval(count, len(rows)) for count in (named, other, missed)]
        lines.append(f"| {kind} {error:g} | {' | '.join(counts)} |")
    return "\n".join(lines)


def main() -> None:
    """Ask all surveys that were not asked before."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=_seeds, default=_seeds("0-59"))
    parser.add_argument("--exact", type=Path, nargs="*", default=(), help="drawn surveys with exact poses")
    parser.add_argument("--field", type=Path, help="folder of surveys that field_surveys.py drew")
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    path = options.folder / RESULTS
    records = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    for name, survey in surveys(options, {record["name"] for record in records}):
        try:
            records.append(asked(name, survey))
        except SurveyError as error:
            records.append({"name": name, "views": len(survey.views), "rows": [], "words": str(error)})
        path.write_text(json.dumps(records), encoding="utf-8")
    print(table(records))  # noqa: T201


if __name__ == "__main__":
    main()
