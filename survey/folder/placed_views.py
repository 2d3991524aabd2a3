"""The views of a survey in its local frame with priors and control, from a poses file or structure from motion.

A block whose positions lie below its water, as with barometric heights, gets initial heights above it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geo.frames import LocalFrame
from refract import FlatWater
from survey.control.points import Checkpoint, Control
from survey.display.quantities import named
from survey.errors import Findings, ImageError
from survey.folder.checked_control import ControlledBlock, checked_parts
from survey.folder.control import place_control
from survey.folder.found import Found
from survey.folder.local_frame import over_points
from survey.folder.pairing import read_file_poses, require_image
from survey.folder.plausible import most_over_water
from survey.folder.pose_frames import TiePointMisfit
from survey.folder.pose_priors import PosePrior, common_up_std, priors_of_gps
from survey.folder.sfm_views import solve_views
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES
from survey.photos.images import is_hidden, read_mask, require_all_complete
from survey.photos.names import MASK_ENDING, ImageNames
from survey.photos.pixels import open_image, stored_size
from survey.photos.poses import TiePoints
from survey.water.surface import Departure, height_above

# Masks that are checked for inversion; decoding thousands would take minutes.
_NUM_LOOKED_AT = 5
# Masks that exclude more than this share of a photograph are probably inverted.
_MOST_LEFT_OUT = 0.8


def with_masks(found: Found, views: Sequence[View], own: Path | None) -> tuple[list[View], Findings]:
    """The views with their masks, by name: that of the image, IMG.png, IMG.jpg.png, or IMG_mask with any suffix.

    Names are those of `survey.photos.names.ImageNames`: a mask is of one photograph alone.

    They are taken from the folder in [images] masks; else, if there are any, from the folder that the program that made
    the poses used; else from IMG_mask next to the images, as for OpenDroneMap.
    """
    given = None if found.config.images.masks is None else found.folder / found.config.images.masks
    if given is not None and not given.is_dir():
        raise ImageError(f"the mask folder {given} does not exist; correct [images] masks in survey.toml")
    masked, where = list(views), ""
    for folder in [given] if given is not None else [own, None] if own is not None else [None]:
        masked = _masked(found, views, folder)
        where = "beside the images" if folder is None else f"in {folder}"
        if any(view.mask_path is not None for view in masked):
            break
    without = [view.name for view in masked if view.mask_path is None]
    if len(without) == len(views):
        if given is None:
            return masked, Findings()
        raise ImageError(
            f"no mask in {given} has the name of an image, expected e.g. {Path(views[0].name).stem}.png; rename them"
        )
    _require_sizes(masked)
    message = f"the masks are those {where}, of {len(views) - len(without)} images; black is left out"
    warnings = (*named(without, "image", "without a mask, used whole"), *_warnings(masked))
    return masked, Findings((message,) if given is None else (), warnings)


def _masked(found: Found, views: Sequence[View], folder: Path | None) -> list[View]:
    """The views with the masks in a folder, or next to the images; views without a mask are unchanged."""
    root = found.folder / found.config.images.local_dir if folder is None else folder
    names, masks = ImageNames(found.images), dict[str, tuple[int, Path]]()
    for path in _files(found, root, is_beside=folder is None):
        candidates = _names_by_mask(path.relative_to(root), is_beside=folder is None)
        rank, name = next(((i, n) for i, c in enumerate(candidates) if (n := names.find(c, str(path)))), (0, None))
        if name is None:
            continue
        before = masks.get(name)
        if before is not None and before[0] == rank:
            raise ImageError(f"{before[1]} and {path} are both masks of {name}; remove one of them")
        if before is None or rank < before[0]:
            masks[name] = (rank, path)
    return [replace(view, mask_path=masks[view.name][1] if view.name in masks else None) for view in views]


def _files(found: Found, root: Path, *, is_beside: bool) -> list[Path]:
    """The files that may be masks, without photographs of the survey."""
    photographs = set(found.images.values())
    folders = sorted({path.parent for path in photographs})
    below = (path for folder in folders for path in folder.iterdir()) if is_beside else root.rglob("*")
    return sorted(
        path
        for path in below
        if path.suffix.lower() in SUFFIXES
        and path not in photographs
        and not is_hidden(path.relative_to(root))
        and path.is_file()
    )


def _names_by_mask(mask: Path, *, is_beside: bool) -> list[str]:
    """Names of the photograph that a mask may belong to, by its path: the longest match first."""
    full_name, stem = mask.as_posix(), mask.with_suffix("").as_posix()
    ending = [stem[: -len(MASK_ENDING)]] if stem.lower().endswith(MASK_ENDING) else []
    return ending if is_beside else [full_name, stem, *ending]


def _require_sizes(views: Sequence[View]) -> None:
    for view in views:
        if view.mask_path is None:
            continue
        with open_image(view.mask_path) as image:
            found, expected = stored_size(image), (view.lens.width, view.lens.height)
        if found != expected:
            raise ImageError(
                f"the mask {view.mask_path} has {found[0]} x {found[1]} pixels, expected {expected[0]} x "
                f"{expected[1]} as its photograph has; make it from the photograph as it is stored"
            )


def _warnings(views: Sequence[View]) -> list[str]:
    """Warning where masks leave out most of their photographs."""
    paths = [view.mask_path for view in views if view.mask_path is not None]
    some = np.unique(np.linspace(0, len(paths) - 1, _NUM_LOOKED_AT).astype(int))
    left_out = float(np.median([1.0 - read_mask(paths[i]).mean() for i in some]))
    if left_out <= _MOST_LEFT_OUT:
        return []
    return [
        f"masks leave out {left_out:.0%} of their photographs (median of {len(some)}): black is what is left out; if "
        "theirs is white, invert them"
    ]


@dataclass(frozen=True)
class PlacedViews:
    """Views that a poses file or structure from motion placed."""

    found: Found  # The contents of the survey folder, with the level that clicks give where a poses file places these
    frame: LocalFrame
    views: list[View]  # Sorted by name, with their masks
    # points, ties, tool, reprojection, priors, control, checkpoints: See `survey.folder.survey.Survey`
    points: np.ndarray | None
    ties: TiePoints | None
    tool: str | None
    reprojection: TiePointMisfit | None
    priors: Mapping[str, PosePrior]
    control: Control | None
    checkpoints: tuple[Checkpoint, ...]


def views_of_file(found: Found, path: Path) -> tuple[PlacedViews, Findings]:
    """Views with the poses of a file."""
    file, findings = read_file_poses(found, path)
    found, frame = file.found, file.frame
    views, of_images = _with_images(found, file.views, file.masks)
    control, checkpoints, of_control = place_control(found.control, frame, [view.name for view in views])
    priors = file.priors if control is None else _held_by_control(file.priors)
    placed = PlacedViews(
        found, frame, views, file.points, None, file.tool, file.reprojection, priors, control, checkpoints
    )
    return placed, findings + of_images + of_control


def views_of_photographs(
    found: Found, workspace: Path | None, report: Callable[[str], None] | None
) -> tuple[PlacedViews, Findings]:
    """The views that structure from motion places."""
    solved, rejected, findings = solve_views(found, workspace, report)
    frame = solved.frame
    views, of_images = _with_images(found, list(solved.views), None)
    priors: Mapping[str, PosePrior] = priors_of_gps(found, frame, views, rejected)
    control, checkpoints, of_control = place_control(found.control, frame, [view.name for view in views])
    findings += of_images + of_control
    priors = priors if control is None else _held_by_control(priors)
    block, of_parts = checked_parts(found, frame, ControlledBlock(views, solved.ties, control, priors))
    placed = PlacedViews(
        found, frame, block.views, block.ties.start, block.ties, None, None, block.priors, block.control, checkpoints
    )
    return placed, findings + of_parts


def _held_by_control(priors: Mapping[str, PosePrior]) -> dict[str, PosePrior]:
    return {name: prior.held_by_control() for name, prior in priors.items()}


def _with_images(found: Found, views: list[View], masks: Path | None) -> tuple[list[View], Findings]:
    """Views by name with their masks; images must have the size of their lens."""
    views, findings = with_masks(found, sorted(views, key=lambda view: view.name), masks)
    for view in views:
        require_image(view, found.headers[view.name])
    require_all_complete([path for view in views for path in (view.path, view.mask_path) if path is not None])
    return views, findings


def shifted_above_water(
    placed: PlacedViews, water: FlatWater | None, departure: Departure | None
) -> tuple[PlacedViews, Findings]:
    """Views shifted in height where all cameras lie under the water, of known level, or far above it.

    Only if positions share an unknown height error, which the adjustment estimates from the water. A warning says by
    how much.
    """
    if water is None or placed.ties is None or placed.control is not None or common_up_std(placed.priors) == 0.0:
        return placed, Findings()
    views = placed.views
    centres = np.array([view.camera.centre for view in views])
    over = height_above(water, departure, centres)
    most_m = most_over_water([view.camera for view in views])
    if over.min() > 0.0 and over.max() < most_m:
        return placed, Findings()
    x, y, _ = np.median(centres, axis=0).tolist()
    level = float(water.height(x, y)) + (0.0 if departure is None else float(departure.at(np.array([[x, y]]))[0][0]))
    up = level - over_points(placed.ties.start, centres)
    message = "under the water" if over.min() <= 0.0 else f"more than {most_m:.0f} m over the water"
    warning = (
        f"the heights of their positions put the cameras {message} ({over.min():.1f} to {over.max():.1f} m over it): "
        "the height of the block is taken from the water level; check level_m and its vertical datum"
    )
    shift = np.array([0.0, 0.0, up])
    ties = replace(placed.ties, start=placed.ties.start + shift)
    views = [replace(view, camera=replace(view.camera, centre=view.camera.centre + shift)) for view in views]
    return replace(placed, views=views, ties=ties, points=ties.start), Findings(warnings=(warning,))
