"""The poses file of a survey, and photographs paired with its poses by name, with their lenses and masks.

A lens comes from the poses file, else from survey.toml, else from EXIF.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.frames import LocalFrame
from refract.lens import MODELS, Lens, LensError, coefficients_of
from survey.control.reading import require_near
from survey.display.quantities import named
from survey.errors import FILE_NAME, ConfigError, Findings, ImageError, PosesError
from survey.folder import local_frame
from survey.folder.found import MIN_VIEWS, Circumstances, Found, below, unused_keys
from survey.folder.gps_placement import place_poses
from survey.folder.observations import Observations, PlacedViews, Provenance
from survey.folder.plausible import angle_warnings
from survey.folder.pose_priors import priors_of_gps, priors_of_poses
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES, Exif
from survey.photos.images import is_hidden, read_mask
from survey.photos.pixels import open_image, require_pixels, stored_size
from survey.photos.poses import MASK_ENDING, DuplicatePose, ImageNames, Pose, PoseFile, least_track
from survey.pose_files import find_poses, read_poses, read_ties
from survey.settings.config import CamerasConfig
from survey.settings.tables import per_axis
from survey.sfm.gps import EXACT, DatumStd, plan_std, require_accurate
from survey.water.level import with_level_of_clicks

# Masks that are checked for inversion; decoding thousands would take minutes.
_NUM_LOOKED_AT = 5
# Masks that exclude more than this share of a photograph are probably inverted.
_MOST_LEFT_OUT = 0.8


def pair(found: Found, poses: Sequence[Pose]) -> tuple[dict[str, Pose], Findings]:
    """The poses that have an image, by the name in the poses file, with that of the image in them.

    Warns of images without a pose and of poses without an image.
    """
    names = ImageNames(found.images)
    paired: dict[str, Pose] = {}
    taken: set[str] = set()
    unmatched = []
    # Exact names first, so that no similar name takes their image.
    for pose in sorted(poses, key=lambda pose: pose.name not in found.images):
        image = names.find(pose.name, str(found.poses_path))
        if image is None or image in taken:
            unmatched.append(pose.name)
        else:
            taken.add(image)
            paired[pose.name] = replace(pose, name=image)
    without_pose = [name for name in found.images if name not in taken]
    if len(paired) < MIN_VIEWS:
        remedy = "add photographs with poses"
        if unmatched and without_pose:
            remedy = f'make the names in the poses those of the images ("{unmatched[0]}" against "{without_pose[0]}")'
        images = found.folder / found.config.images.local_dir
        raise PosesError(
            f"only {len(paired)} of the {len(poses)} poses in {found.poses_path} belong to one of the "
            f"{len(found.images)} images in {images}, expected at least {MIN_VIEWS}; {remedy}"
        )
    warnings = named(without_pose, "image", "without a pose, left out")
    warnings += named(unmatched, "pose", "without an image, left out")
    return paired, Findings(warnings=tuple(warnings))


def require_image(view: View, header: Exif) -> None:
    """Raise ImageError where an image does not have the size of its camera."""
    expected = (view.lens.width, view.lens.height)
    remedy = "use the images that the poses were made from, or correct the size of the camera"
    if header.orientation >= 5 and header.size_px == expected[::-1]:
        remedy = "EXIF marks it as rotated, which is ignored here: rotate the pixels and remove the orientation tag"
    require_pixels(view.path, header.size_px, expected, "its camera", remedy)


def with_masks(found: Found, views: Sequence[View], own: Path | None) -> tuple[list[View], Findings]:
    """The views with their masks, by name: that of the image, IMG.png, IMG.jpg.png, or IMG_mask with any suffix.

    Names are those of `survey.photos.poses.ImageNames`: a mask is of one photograph alone. Masks are taken from the
    folder in [images] masks; else, if there are any, from the folder that the program that made the poses used; else
    from IMG_mask next to the images, as for OpenDroneMap.
    """
    given = None if found.config.images.masks is None else found.folder / found.config.images.masks
    if given is not None and not given.is_dir():
        raise ImageError(f"the mask folder {given} does not exist; correct [images] masks in survey.toml")
    folder, masks = masks_of(found, [view.name for view in views], own)
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


def masks_of(found: Found, names: Iterable[str], own: Path | None) -> tuple[Path | None, dict[str, Path]]:
    """The folder of the masks of photographs, None for beside them, and the masks by photograph: see `with_masks`."""
    if found.config.images.masks is not None:
        given = found.folder / found.config.images.masks
        return given, _masks_in(found, given)
    if own is not None and not (masks := _masks_in(found, own)).keys().isdisjoint(names):
        return own, masks
    return None, _masks_in(found, None)


def _masks_in(found: Found, folder: Path | None) -> dict[str, Path]:
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


def lenses_from_config(cameras: CamerasConfig, headers: dict[str, Exif]) -> tuple[dict[str, Lens], Findings]:
    """The lens of each image: one for all, or one for each camera where survey.toml gives no parameter.

    Cameras are told apart by maker, model and serial number, size, and focal length in EXIF. Parameters and errors are
    those of `lens_from_config`.
    """
    groups: dict[tuple, dict[str, Exif]] = {}
    if (cameras.size_px, cameras.focal_px, cameras.principal_point_px, cameras.distortion) == (None,) * 4:
        for name, header in headers.items():
            # Focal lengths within 1 % are roundings of one.
            focal = None if header.focal_px is None else round(100.0 * math.log(header.focal_px))
            kind = (header.camera, header.serial, header.size_px, focal, header.focal_warning)
            groups.setdefault(kind, {})[name] = header
    if len(groups) < 2 or any(header.focal_px is None for header in headers.values()):
        lens, findings = lens_from_config(cameras, headers)
        return dict.fromkeys(headers, lens), findings
    lenses: dict[str, Lens] = {}
    notes: list[str] = []
    for (camera, *_), own in groups.items():
        lens, findings = lens_from_config(cameras, own)
        lenses |= dict.fromkeys(own, lens)
        notes += [f"{camera or 'a camera without a name'}, {len(own)} images: {note}" for note in findings.assumptions]
    return lenses, Findings(tuple(notes))


def lens_from_config(cameras: CamerasConfig, headers: dict[str, Exif]) -> tuple[Lens, Findings]:
    """Lens for all images with a pose, with a note for each parameter that survey.toml does not give."""
    sizes = {header.size_px: name for name, header in headers.items()}
    if cameras.size_px is None and len(sizes) > 1:
        (a, name_a), (b, name_b) = list(sizes.items())[:2]
        raise ConfigError(
            f"images have different sizes ({name_a}: {a[0]} x {a[1]}, {name_b}: {b[0]} x {b[1]}), expected one "
            "camera; give size_px in [cameras] and leave out the others, or poses with a camera per image (COLMAP)"
        )
    width, height = cameras.size_px or next(iter(sizes))
    (fx, fy), notes = _focal(cameras, headers)
    if cameras.principal_point_px is None:
        notes = (*notes, "the principal point is the centre of the image")
    cx, cy = cameras.principal_point_px or (0.5 * width, 0.5 * height)
    model = cameras.model or ("PINHOLE" if fx != fy else "SIMPLE_PINHOLE")
    if model not in MODELS:
        raise ConfigError(f'[cameras] model is "{model}" in {FILE_NAME}, expected one of {", ".join(MODELS)}')
    names = MODELS[model][1]
    if "f" in names and fx != fy:
        raise ConfigError(
            f"[cameras] model {model} has one focal length, but focal_px is [{fx:g}, {fy:g}] in {FILE_NAME}; give "
            "one number, or a model with fx and fy"
        )
    coefficients = coefficients_of(model)
    given = cameras.distortion or ()
    if len(given) != len(coefficients):
        raise ConfigError(
            f"[cameras] distortion has {len(given)} numbers in {FILE_NAME}, expected {len(coefficients)} for the "
            f"model {model}{': ' + ', '.join(coefficients) if coefficients else ''}"
        )
    values = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(zip(coefficients, given, strict=True))}
    try:
        return Lens(model, tuple(values[name] for name in names), width, height), Findings(notes)
    except LensError as error:
        raise ConfigError(f"[cameras] in {FILE_NAME}: {error}") from error


def _focal(cameras: CamerasConfig, headers: dict[str, Exif]) -> tuple[tuple[float, float], tuple[str, ...]]:
    if (given := cameras.focal_px) is not None:
        return given if isinstance(given, tuple) else (given, given), ()
    focals = sorted(header.focal_px for header in headers.values() if header.focal_px is not None)
    if not focals:
        raise ConfigError(
            f"focal_px is missing from [cameras] in {FILE_NAME}, and EXIF does not give it; give the calibrated "
            "focal length in pixels, e.g. focal_px = 3650.0"
        )
    if focals[-1] > 1.01 * focals[0]:
        raise ConfigError(
            f"EXIF gives focal lengths from {focals[0]:.0f} to {focals[-1]:.0f} px, expected one camera; give focal_px "
            f"in [cameras] in {FILE_NAME}, or poses with a camera per image (COLMAP)"
        )
    note = f"the focal length is {focals[0]:.1f} px, a design value from EXIF and not a calibration"
    return (focals[0], focals[0]), (note,)


def read_file_poses(found: Found, path: Path) -> tuple[PlacedViews, Path | None, Findings]:
    """Read the poses file of a survey; also the folder of masks that its program used."""
    try:
        file = read_poses(path)
    except DuplicatePose as error:
        # Two photographs of one name are what the user can correct: that error comes first.
        ImageNames(found.images).find(error.name_in_file, str(path))
        raise
    cameras = found.config.cameras
    paired, of_pairs = pair(found, file.poses)
    findings = Findings(tuple(file.notes), tuple(file.warnings)) + of_pairs
    poses = list(paired.values())
    if any(pose.lens is None for pose in poses):
        lenses, added = lenses_from_config(cameras, {pose.name: found.headers[pose.name] for pose in poses})
        findings += added
        poses = [replace(pose, lens=pose.lens or lenses[pose.name]) for pose in poses]
    placed, of_place = place_poses(found, file, poses)
    file, poses = placed.file, placed.poses
    datum, of_datum = _datum(found, file)
    found, of_clicks = _with_clicked_level(found, file, poses)
    lens = file.poses[0].lens if all(pose.lens is not None for pose in file.poses) else None
    circumstances = Circumstances(
        found.config, found.headers, below(found.folder, path), file.frame, placed.by_gps is not None, lens,
        len(find_poses(found.folder)) > 1,
    )  # fmt: skip
    warnings = [*angle_warnings(poses, file.frame), *unused_keys(circumstances)]
    bent: tuple[str, ...] = ()
    frame, views = local_frame.views_in_local(found, file, poses)
    if file.tool is not None and found.config.water is not None:
        bent = (
            f"{file.tool} ignores refraction: tie points under water have biased its poses, which are therefore "
            "adjusted with bent rays unless --poses fixed keeps them",
        )
    centres = np.array([view.camera.centre for view in views])
    warnings += require_near(found.control.points, frame.crs_from_local(centres), frame.crs)
    by_name = {view.name: view for view in views}
    ties, points, misses = read_ties(path), None, None
    if ties is not None:
        points = local_frame.points_in_local(file, placed.points(ties), frame, cameras.gps_height)
        misses = local_frame.reprojection(ties, points, {name: by_name[pose.name] for name, pose in paired.items()})
        good = np.isfinite(points).all(axis=1) & (ties.num_views >= least_track(len(views)))
        points = points[good]
    if placed.by_gps is None:
        priors = priors_of_poses(cameras, views, _given(found, file, poses, frame), datum)
    else:
        priors = {name: replace(prior, attitude=None) for name, prior in priors_of_gps(found, frame, views).items()}
    placed_views = PlacedViews(found, frame, views, Observations(points, priors=priors), Provenance(file.tool, misses))
    return placed_views, file.masks, findings + of_place + of_datum + of_clicks + Findings(bent, tuple(warnings))


def _datum(found: Found, file: PoseFile) -> tuple[DatumStd, Findings]:
    """Std that the transformation of the poses into crs adds, with a warning where it does."""
    transformation = local_frame.transformation_into_crs(file, found.crs)
    if transformation is None:
        return EXACT, Findings()
    std = found.config.cameras.position_std_m
    stated = 0.0 if std is None else max(per_axis(std)[:2])
    require_accurate(transformation, stated, "the poses", len(found.control.given))
    warning = transformation.warning("the poses")
    return DatumStd(plan_std(transformation)), Findings(warnings=() if warning is None else (warning,))


def _with_clicked_level(found: Found, file: PoseFile, poses: list[Pose]) -> tuple[Found, Findings]:
    """The contents with the water level from clicks in the photographs, where [water] names them."""
    water = found.config.water
    if water is None or water.clicks is None:
        return found, Findings()
    # The frame of the survey lies at the level, which is not known yet: another serves here.
    frame, views = local_frame.views_in_local(replace(found, config=replace(found.config, water=None)), file, poses)
    config, clicked, findings = with_level_of_clicks(found.folder, found.config, views, frame)
    return replace(found, config=config, levels=found.levels + clicked), findings


def _given(
    found: Found, file: PoseFile, poses: list[Pose], frame: LocalFrame
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Positions before adjustment, in local, that the file gives, with their standard deviations."""
    known = {pose.name: pose.given for pose in poses if pose.given is not None}
    if not known:
        return {}
    places = np.array([given.place for given in known.values()])
    local = local_frame.given_in_local(file, places, frame, found.config.cameras.gps_height)
    stds = zip(known, local, known.values(), strict=True)
    return {name: (position, given.std) for name, position, given in stds if np.isfinite(position).all()}
