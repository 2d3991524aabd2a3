"""The surveys of a benchmark: folders with a known truth, and drawn ones."""

import math
import tomllib
from dataclasses import dataclass
from pathlib import Path

import tomli_w

from survey.errors import FILE_NAME, SurveyError
from survey.progress import current
from survey.settings.config import read_config
from survey.simulate.drawn import DrawnScene, draw_survey
from survey.words import RUN_FOLDER

REFERENCE, VISIBLE, TRUTH = "reference.ply", "visible.ply", "truth"
# Names of poses: as the survey has them, or found from its photographs and their GPS positions.
GIVEN, IMAGES = POSES = ("given", "images")
# What --drawn all stands for.
DEPTHS_M, PATTERNS, NUM_IMAGES = (0.5, 2.0, 3.5, 8.0), {"nadir": 1.0, "oblique": 0.6}, (20, 130, 520)
# Photographs per square metre of the survey of the demo, which larger ones have too.
_IMAGES_PER_M2 = 20 / 110.0


@dataclass(frozen=True)
class Case:
    """A survey whose bed is known."""

    name: str
    folder: Path  # Survey folder; never written to
    # reference, visible: The true bed, and the points of it that cameras see; None where these are not known
    reference: Path
    visible: Path | None
    bounds: tuple[float, float, float, float] | None  # (e0, n0, e1, n1) or None: where the cloud is compared


def case_of(folder: Path) -> Case:
    """A survey folder with reference.ply, and visible.ply if there is one, in it or in its folder truth/."""
    config = read_config(folder / FILE_NAME)
    for place in (folder, folder / TRUTH):
        if (place / REFERENCE).is_file():
            visible = place / VISIBLE
            name = folder.resolve().name
            return Case(name, folder, place / REFERENCE, visible if visible.is_file() else None, config.area.bounds)
    raise SurveyError(
        f"{folder} has no {REFERENCE}, nor has its folder {TRUTH}/; a benchmark needs the true bed: give a survey of "
        "`bathynerf simulate`, or use `bathynerf compare` with your own reference"
    )


def drawn_names(words: list[str]) -> list[str]:
    """Names DEPTH,PATTERN,IMAGES of drawn surveys, checked; "all" stands for each depth, pattern and number."""
    if "all" in words:
        return [f"{depth:g},{pattern},{n}" for n in NUM_IMAGES for depth in DEPTHS_M for pattern in PATTERNS]
    for word in words:
        _scene_of(word)
    return words


def drawn_case(word: str, folder: Path) -> Case:
    """Draw the survey of a name into a folder, unless it is there."""
    place = folder / f"drawn_{word.replace(',', '_')}"
    draw_survey(place, _scene_of(word), progress=current())
    return case_of(place)


def _scene_of(word: str) -> DrawnScene:
    try:
        depth_text, pattern, number = (part.strip() for part in word.split(","))
        depth, num_views, nadir_share = float(depth_text), int(number), PATTERNS[pattern]
    except (ValueError, KeyError) as error:
        raise SurveyError(
            f"--drawn is {word!r}, expected DEPTH,PATTERN,IMAGES with a depth in metres, {' or '.join(PATTERNS)} and a "
            'number of photographs, e.g. "2,oblique,20", or "all"'
        ) from error
    if not (math.isfinite(depth) and depth > 0.0):
        raise SurveyError(f"--drawn is {word!r} with a depth of {depth:g} m; give one above zero")
    # Too few are refused by the scene.
    side = math.sqrt(max(num_views, 1) / _IMAGES_PER_M2)
    size = (round(1.05 * side, 1), round(0.95 * side, 1))
    return DrawnScene(depth_m=depth, num_views=num_views, nadir_share=nadir_share, size_m=size)


def variant(case: Case, folder: Path, *, poses: str, is_refracted: bool) -> Path:
    """A survey folder of links to the files of a case, with other settings; made where it is not there yet.

    With poses "images", [cameras] poses and [local] are left out, and files of poses are not linked, nor the folder
    that they are in, unless it holds the photographs. Without refraction [water] is left out.
    """
    table = tomllib.loads((case.folder / FILE_NAME).read_text(encoding="utf-8"))
    left_out = {case.folder / FILE_NAME, case.folder / RUN_FOLDER}
    if poses == IMAGES:
        given = Path(table.get("cameras", {}).pop("poses", "cameras.csv"))
        top, images = case.folder / given.parts[0], case.folder / read_config(case.folder / FILE_NAME).images.local_dir
        left_out |= {case.folder / given if images.is_relative_to(top) else top}
        left_out |= {case.folder / name for name in ("cameras.csv", "sparse")}
        table.pop("local", None)
    if not is_refracted:
        table.pop("water", None)
    _link(case.folder, folder, left_out)
    (folder / FILE_NAME).write_text(tomli_w.dumps(table), encoding="utf-8")
    return folder


def _link(source: Path, target: Path, left_out: set[Path]) -> None:
    """Link the entries of a folder in another; one that holds something left out becomes a folder of links."""
    target.mkdir(parents=True, exist_ok=True)
    for path in source.iterdir():
        link = target / path.name
        if path in left_out or link.is_symlink():
            continue
        if any(path in each.parents for each in left_out):
            _link(path, link, left_out)
        else:
            link.symlink_to(path.resolve())
