"""The cameras of a run for other programs to train on: a COLMAP model, and nerfstudio's transforms.json.

Both formats assume straight rays. The poses are the true ones, so the ray of a pixel is right down to the water. There
it bends; the files state the plane and the index. A program that traces straight rays sees the bed about a quarter too
shallow, and blurred, since each camera sees it elsewhere.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.crs import crs_code
from geo.files import reporting_disk_errors, write_text
from refract.lens import Lens
from survey.errors import SurveyError
from survey.export.loaded import LoadedRun
from survey.export.registry import ExportOptions
from survey.photos.colmap_model import write_model
from survey.run.flight import Flight

_MARK = "# bathynerf\n"
# Initial points for training; more take longer and help little.
_MOST_POINTS = 200_000


def _metadata(flight: Flight) -> dict:
    """Frame and water, for JSON."""
    frame, water = flight.frame, flight.water
    metadata = {
        "made_by": "bathynerf",
        "frame": "topocentric east-north-up, metres",
        "crs": crs_code(frame.crs) or frame.crs.to_wkt(),
        "origin_in_crs": list(frame.origin),
    }
    if any(view.camera.motion is not None for view in flight.views):
        metadata["rolling_shutter"] = "positions are those at the middle row; motion during the readout is left out"
    if water is None:
        return metadata | {"rays": "straight: a dry survey"}
    level = float(water.height(0.0, 0.0))
    plane = {"level": level, "slope_x": float(water.slope_x), "slope_y": float(water.slope_y)}
    return metadata | {
        "water_plane": plane,
        "refractive_index": float(water.n_water),
        "rays": "straight from the camera to the plane z = level + slope_x x + slope_y y, bent there by Snell's law; a "
        "program without refraction sees the bed too shallow",
    }


def _in_colmap(lens: Lens) -> Lens:
    """The lens in a model of COLMAP."""
    if lens.model != "BROWN_AFFINE":
        return lens
    if lens["k4"] or lens["skew"]:
        raise SurveyError(
            "the lens has k4 or skew (Metashape's k4, b2), which no camera model of COLMAP has; undistort the "
            "photographs with the program that made the lens, and process them instead"
        )
    params = [lens[name] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")]
    return replace(lens, model="FULL_OPENCV", params=(*params, 0.0, 0.0, 0.0))


def write_colmap(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """The cameras as a COLMAP model."""
    flight = run.flight
    views = [replace(view, lens=_in_colmap(view.lens)) for view in flight.views]
    comments = [f"# {name}: {json.dumps(value, ensure_ascii=False)}\n" for name, value in _metadata(flight).items()]
    # True, not apparent, positions of points of the bed.
    bed = run.bed.bed
    every = -(-len(bed) // _MOST_POINTS)
    points = "# points of the bed, true places; no tracks\n" + "".join(
        f"{number} {x:.4f} {y:.4f} {z:.4f} {r} {g} {b} 0\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(bed.xyz[::every], bed.rgb[::every], strict=True), start=1)
    )
    with reporting_disk_errors(path):
        path.mkdir(parents=True, exist_ok=True)
        write_model(path, views, head=_MARK + "".join(comments), points=points)


def write_nerfstudio(path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """The cameras as nerfstudio has them."""
    flight = run.flight
    frames = []
    for view in flight.views:
        matrix = np.eye(4)
        # Its cameras look along -z, with y up.
        matrix[:3, :3] = view.camera.cam_from_local.T * np.array([1.0, -1.0, -1.0])
        matrix[:3, 3] = view.camera.centre
        frame = {"file_path": str(view.path), **_nerfstudio_lens(view.lens), "transform_matrix": matrix.tolist()}
        frames.append(frame if view.mask_path is None else frame | {"mask_path": str(view.mask_path)})
    content = {"bathynerf": _metadata(flight), "frames": frames}
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False))


def _nerfstudio_lens(lens: Lens) -> dict:
    rational = lens.model == "FULL_OPENCV"
    if lens["skew"] or (rational and (lens["k4"] or lens["k5"] or lens["k6"])):
        raise SurveyError(
            "the lens has skew or the denominator of the rational model (k4 to k6), which nerfstudio lacks; undistort "
            "the photographs with the program that made the lens, and process them instead"
        )
    fx, fy = lens.focal
    inside = {"fl_x": fx, "fl_y": fy, "cx": lens["cx"], "cy": lens["cy"], "w": lens.width, "h": lens.height}
    names = ("k1", "k2", "k3") if rational else ("k1", "k2", "k3", "k4")
    model = "OPENCV_FISHEYE" if lens.model == "OPENCV_FISHEYE" else "OPENCV"
    return {"camera_model": model, **inside, **{name: lens[name] for name in (*names, "p1", "p2")}}


def check_colmap(_path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """Raise SurveyError where a lens has no model there."""
    for view in run.flight.views:
        _in_colmap(view.lens)


def check_nerfstudio(_path: Path, run: LoadedRun, _options: ExportOptions) -> None:
    """Raise SurveyError where a lens has no model there."""
    for view in run.flight.views:
        _nerfstudio_lens(view.lens)
