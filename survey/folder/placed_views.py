"""The views of a survey in its local frame with priors and control, from a poses file or structure from motion.

A block whose positions lie below its water, as with barometric heights, gets initial heights above it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from refract import FlatWater
from survey.display.quantities import named
from survey.errors import Findings, ImageError
from survey.folder.checked_control import checked_parts
from survey.folder.control import place_control
from survey.folder.found import Found
from survey.folder.local_frame import over_points
from survey.folder.observations import Observations, PlacedViews
from survey.folder.pairing import read_file_poses, require_image
from survey.folder.plausible import most_of_cameras
from survey.folder.pose_priors import common_up_std, priors_of_gps
from survey.folder.sfm_views import solve_views
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES
from survey.photos.images import is_hidden, read_mask, require_all_complete
from survey.photos.pixels import open_image, require_pixels, stored_size
from survey.photos.poses import MASK_ENDING, ImageNames
from survey.water.surface import Departure, height_above

# Masks that are checked for inversion; decoding thousands would take minutes.
_NUM_LOOKED_AT = 5
# Masks that exclude more than this share of a photograph are probably inverted.
_MOST_LEFT_OUT = 0.8


def with_masks(found: Found, views: Sequence[View], own: Path | None) -> tuple[list[View], Findings]:
    """The views with their masks, by name: that of the image, IMG.png, IMG.jpg.png, or IMG_mask with any suffix.

    Names are those of `survey.photos.poses.ImageNames`: a mask is of one photograph alone. Masks are taken from the
    folder in [images] masks; else, if there are any, from the folder that the program that made the poses used; else
    from IMG_mask next to the images, as for OpenDroneMap.
    """
    given = None if found.config.images.masks is None else found.folder / found.config.images.masks
    if given is not None and not given.is_dir():
        raise ImageError(f"the mask folder {given} does not exist; correct [images] masks in survey.toml")
    masks: dict[str, Path] = {}
    folder: Path | None = given
    for folder in [given] if given is not None else [own, None] if own is not None else [None]:
        masks = _masks(found, folder)
        if any(view.name in masks for view in views):
            break
    masked = [replace(view, mask_path=masks.get(view.name)) for view in views]
    paths = [view.mask_path for view in masked if view.mask_path is not None]
    if not paths:
        if given is None:
            return masked, Findings()
        raise ImageError(f"no mask in {given} is named like an image, e.g. {Path(views[0].name).stem}.png; rename them")
    for view in masked:
        if view.mask_path is not None:
            with open_image(view.mask_path) as image:
                found_px, expected_px = stored_size(image), (view.lens.width, view.lens.height)
            remedy = "make it from the photograph as it is stored"
            require_pixels(f"the mask {view.mask_path}", found_px, expected_px, "its photograph", remedy)
    where = "beside the images" if folder is None else f"in {folder}"
    notes = () if given is not None else (f"the masks are those {where}, of {len(paths)} images; black is left out",)
    warnings = named([view.name for view in masked if view.mask_path is None], "image", "without a mask, used whole")
    some = np.unique(np.linspace(0, len(paths) - 1, _NUM_LOOKED_AT).astype(int))
    left_out = float(np.median([1.0 - read_mask(paths[i]).mean() for i in some]))
    if left_out > _MOST_LEFT_OUT:
        warnings.append(
            f"masks leave out {left_out:.0%} of their photographs (median of {len(some)}): black is what is left out; "
            "if theirs is white, invert them"
        )
    return masked, Findings(notes, tuple(warnings))


def _masks(found: Found, folder: Path | None) -> dict[str, Path]:
    """The masks in a folder, or next to the images, by the name of the photograph."""
    root = found.folder / found.config.images.local_dir if folder is None else folder
    photographs, names, masks = set(found.images.values()), ImageNames(found.images), dict[str, tuple[int, Path]]()
    folders = sorted({path.parent for path in photographs})
    below = root.rglob("*") if folder is not None else (path for place in folders for path in place.iterdir())
    for path in sorted(path for path in below if path.suffix.lower() in SUFFIXES and path not in photographs):
        inside = path.relative_to(root)
        if is_hidden(inside) or not path.is_file():
            continue
        # Names of the photograph that it may belong to, the longest match first.
        stem = inside.with_suffix("").as_posix()
        candidates = [stem[: -len(MASK_ENDING)]] if stem.lower().endswith(MASK_ENDING) else []
        candidates = candidates if folder is None else [inside.as_posix(), stem, *candidates]
        rank, name = next(((i, n) for i, c in enumerate(candidates) if (n := names.find(c, str(path)))), (0, None))
        if name is None:
            continue
        before = masks.get(name, (rank + 1, path))
        if before[0] == rank:
            raise ImageError(f"{before[1]} and {path} are both masks of {name}; remove one of them")
        masks[name] = min(before, (rank, path))
    return {name: path for name, (_, path) in masks.items()}


def views_of_file(found: Found, path: Path) -> tuple[PlacedViews, Findings]:
    """Views with the poses of a file."""
    placed, masks, findings = read_file_poses(found, path)
    placed, added = _with_images(placed, masks)
    placed, of_control = _with_control(placed)
    return placed, findings + added + of_control


def views_of_photographs(
    found: Found, workspace: Path | None, report: Callable[[str], None] | None
) -> tuple[PlacedViews, Findings]:
    """The views that structure from motion places."""
    solved, rejected, findings = solve_views(found, workspace, report)
    placed, added = _with_images(PlacedViews(found, solved.frame, list(solved.views)), None)
    priors = priors_of_gps(found, placed.frame, placed.views, rejected)
    headers = {view.name: found.headers[view.name] for view in placed.views}
    focals = {name: each.focal_px for name, each in headers.items() if each.focal_px and not each.focal_warning}
    placed = replace(placed, observations=Observations(solved.ties.start, solved.ties, priors, focals))
    placed, of_control = _with_control(placed)
    placed, of_parts = checked_parts(placed)
    return placed, findings + added + of_control + of_parts


def _with_control(placed: PlacedViews) -> tuple[PlacedViews, Findings]:
    """Views with their control and check points; where control places the block, priors are `held_by_control`."""
    control, checkpoints, findings = place_control(
        placed.found.control, placed.frame, [view.name for view in placed.views]
    )
    priors = placed.observations.priors
    if control is not None:
        priors = {name: prior.held_by_control() for name, prior in priors.items()}
    seen = replace(placed.observations, priors=priors, control=control, checkpoints=checkpoints)
    return replace(placed, observations=seen), findings


def _with_images(placed: PlacedViews, masks: Path | None) -> tuple[PlacedViews, Findings]:
    """Views by name with their masks; images must have the size of their lens."""
    views, findings = with_masks(placed.found, sorted(placed.views, key=lambda view: view.name), masks)
    for view in views:
        require_image(view, placed.found.headers[view.name])
    require_all_complete([path for view in views for path in (view.path, view.mask_path) if path is not None])
    return replace(placed, views=views), findings


def shifted_above_water(
    placed: PlacedViews, water: FlatWater | None, departure: Departure | None
) -> tuple[PlacedViews, Findings]:
    """Views shifted in height where all cameras lie under the water, of known level, or far above it.

    Only if positions share an unknown height error, which the adjustment estimates from the water. A warning says by
    how much.
    """
    seen = placed.observations
    if water is None or seen.ties is None or seen.control is not None or common_up_std(seen.priors) == 0.0:
        return placed, Findings()
    views = placed.views
    centres = np.array([view.camera.centre for view in views])
    over = height_above(water, departure, centres)
    most_m = most_of_cameras([view.camera for view in views])
    if over.min() > 0.0 and over.max() < most_m:
        return placed, Findings()
    x, y, _ = np.median(centres, axis=0).tolist()
    level = float(water.height(x, y)) + (0.0 if departure is None else float(departure.at(np.array([[x, y]]))[0][0]))
    up = level - over_points(seen.ties.start, centres)
    message = "under the water" if over.min() <= 0.0 else f"more than {most_m:.0f} m over the water"
    warning = (
        f"the heights of their positions put the cameras {message} ({over.min():.1f} to {over.max():.1f} m over it): "
        "the height of the block is taken from the water level; check level_m and its vertical datum"
    )
    shift = np.array([0.0, 0.0, up])
    ties = replace(seen.ties, start=seen.ties.start + shift)
    seen = replace(seen, points=ties.start, ties=ties)
    views = [replace(view, camera=replace(view.camera, centre=view.camera.centre + shift)) for view in views]
    return replace(placed, views=views, observations=seen), Findings(warnings=(warning,))
