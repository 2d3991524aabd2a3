"""Photographs paired with their poses by name, with their lenses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from survey.display.words import named
from survey.errors import ImageError, PosesError
from survey.files.csv_table import shortened
from survey.findings import Findings
from survey.folder.found import MIN_VIEWS, Found
from survey.folder.lens import lenses_from_config
from survey.photos.cameras import View
from survey.photos.exif import Exif
from survey.photos.names import ImageNames
from survey.photos.poses import Pose


def pair(found: Found, poses: Sequence[Pose]) -> tuple[dict[str, Pose], Findings]:
    """The poses that have an image, under the name of that image, by the name that their file has.

    Warns of images without a pose and of poses without an image.

    Raises
    ------
    PosesError
        If fewer than two are left.
    ImageError
        If a name fits two images, or an image two names; see `survey.photos.names.ImageNames`.
    """
    names = ImageNames(found.images)
    paired: dict[str, Pose] = {}
    taken: set[str] = set()
    unmatched = []
    # Exact names first, so that no other one takes their image.
    for pose in sorted(poses, key=lambda pose: pose.name not in found.images):
        image = names.find(pose.name, str(found.poses_path))
        if image is None or image in taken:
            unmatched.append(pose.name)
        else:
            taken.add(image)
            paired[pose.name] = replace(pose, name=image)
    without_pose = [name for name in found.images if name not in taken]
    if len(paired) < MIN_VIEWS:
        mend = "add photographs with poses"
        if unmatched and without_pose:
            mend = (
                f'make the names in the poses those of the images ("{shortened(unmatched[0])}" against '
                f'"{without_pose[0]}")'
            )
        raise PosesError(
            f"only {len(paired)} of the {len(poses)} poses in {found.poses_path} belong to one of the "
            f"{len(found.images)} images in {found.folder / found.config.images.dir}, expected at least {MIN_VIEWS}; "
            f"{mend}"
        )
    warnings = named(without_pose, "image", "without a pose, left out")
    warnings += named([shortened(name) for name in unmatched], "pose", "without an image, left out")
    return paired, Findings(warnings=tuple(warnings))


def with_lenses(found: Found, poses: list[Pose]) -> tuple[list[Pose], Findings]:
    """The poses with a lens each: their own, else that of [cameras]."""
    cameras = found.config.cameras
    lens = poses[0].lens
    if lens is None or any(pose.lens is None for pose in poses):
        of_config, said = lenses_from_config(cameras, {pose.name: found.heads[pose.name] for pose in poses})
        return [replace(pose, lens=pose.lens or of_config[pose.name]) for pose in poses], said
    own, size = lens.focal[0], (lens.width, lens.height)
    given = cameras.focal_px[0] if isinstance(cameras.focal_px, tuple) else cameras.focal_px
    warnings = []
    if given is not None and abs(given / own - 1.0) > 0.01:
        warnings.append(
            f"focal_px = {given:g} in survey.toml is not used: {found.poses_path} has its own, {own:.1f} px"
        )
    if cameras.size_px is not None and cameras.size_px != size:
        warnings.append(
            f"size_px = {list(cameras.size_px)} in survey.toml is not used: {found.poses_path} has its own, "
            f"{list(size)}"
        )
    return poses, Findings(warnings=tuple(warnings))


def require_image(view: View, head: Exif) -> None:
    """Raise ImageError where an image does not have the size of its camera."""
    expected = (view.lens.width, view.lens.height)
    if head.size_px != expected:
        mend = "use the images that the poses were made from, or correct the size of the camera"
        if head.orientation >= 5 and head.size_px == expected[::-1]:
            mend = "EXIF marks it as rotated, which is ignored here: rotate the pixels and remove the orientation tag"
        raise ImageError(
            f"{view.path} has {head.size_px[0]} x {head.size_px[1]} pixels, expected {expected[0]} x {expected[1]} "
            f"as its camera has; {mend}"
        )
