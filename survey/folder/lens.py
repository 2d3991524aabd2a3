"""The lens of photographs whose poses file has none: from survey.toml, else from EXIF."""

from __future__ import annotations

import math

from refract.lens import MODELS, Lens, LensError, coefficients_of
from survey.errors import FILE_NAME, ConfigError
from survey.findings import Findings
from survey.photos.exif import Exif
from survey.settings.config import CamerasConfig


def lenses_from_config(cameras: CamerasConfig, heads: dict[str, Exif]) -> tuple[dict[str, Lens], Findings]:
    """The lens of each image: one for all, or one for each camera where survey.toml has no number of them.

    Cameras are told apart by maker and model, size, and focal length in EXIF. Parameters and errors are those of
    `lens_from_config`.
    """
    groups: dict[tuple, dict[str, Exif]] = {}
    if (cameras.size_px, cameras.focal_px, cameras.principal_point_px, cameras.distortion) == (None,) * 4:
        for name, head in heads.items():
            # Focal lengths within 1 % are roundings of one.
            focal = None if head.focal_px is None else round(100.0 * math.log(head.focal_px))
            groups.setdefault((head.camera, head.size_px, focal), {})[name] = head
    if len(groups) < 2 or any(head.focal_px is None for head in heads.values()):
        lens, said = lens_from_config(cameras, heads)
        return dict.fromkeys(heads, lens), said
    lenses: dict[str, Lens] = {}
    notes: list[str] = []
    for (camera, _, _), own in groups.items():
        lens, said = lens_from_config(cameras, own)
        lenses |= dict.fromkeys(own, lens)
        notes += [f"{camera or 'a camera without a name'}, {len(own)} images: {note}" for note in said.assumptions]
    return lenses, Findings(tuple(notes))


def lens_from_config(cameras: CamerasConfig, heads: dict[str, Exif]) -> tuple[Lens, Findings]:
    """One lens for all images, with a sentence for each number that survey.toml does not give.

    Parameters
    ----------
    cameras : CamerasConfig
    heads : name to Exif, of the images that have a pose

    Raises
    ------
    ConfigError
        Where a number is missing, or does not fit the camera model.
    """
    width, height = cameras.size_px or _common_size(heads)
    (fx, fy), said = _focal(cameras, heads)
    if cameras.principal_point_px is None:
        said += Findings(("the principal point is the centre of the image",))
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
        return Lens(model, tuple(values[name] for name in names), width, height), said
    except LensError as error:
        raise ConfigError(f"[cameras] in {FILE_NAME}: {error}") from error


def _common_size(heads: dict[str, Exif]) -> tuple[int, int]:
    sizes = {head.size_px: name for name, head in heads.items()}
    if len(sizes) > 1:
        (a, name_a), (b, name_b) = list(sizes.items())[:2]
        raise ConfigError(
            f"images have different sizes ({name_a}: {a[0]} x {a[1]}, {name_b}: {b[0]} x {b[1]}), expected one "
            "camera; give size_px in [cameras] and leave out the others, or poses with a camera per image (COLMAP)"
        )
    return next(iter(sizes))


def _focal(cameras: CamerasConfig, heads: dict[str, Exif]) -> tuple[tuple[float, float], Findings]:
    if (given := cameras.focal_px) is not None:
        return given if isinstance(given, tuple) else (given, given), Findings()
    found = sorted({head.focal_px for head in heads.values() if head.focal_px is not None})
    if not found:
        raise ConfigError(
            f"focal_px is missing from [cameras] in {FILE_NAME}, and EXIF does not give it; give the calibrated "
            "focal length in pixels, e.g. focal_px = 3650.0"
        )
    if found[-1] > 1.01 * found[0]:
        raise ConfigError(
            f"EXIF gives focal lengths from {found[0]:.0f} to {found[-1]:.0f} px, expected one camera; give focal_px "
            f"in [cameras] in {FILE_NAME}, or poses with a camera per image (COLMAP)"
        )
    said = f"the focal length is {found[0]:.1f} px, a design value from EXIF and not a calibration"
    return (found[0], found[0]), Findings((said,))
