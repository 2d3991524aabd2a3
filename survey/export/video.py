"""A flight along key cameras, as a video."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, RotationSpline

from fields.image_based import NovelView
from geo.files import write_whole
from refract import PinholeCamera
from survey.errors import OutputError, SurveyError
from survey.progress import current

FRAMES_PER_S = 25


def flown(keys: Sequence[PinholeCamera], seconds: float) -> list[PinholeCamera]:
    """Cameras of a flight of so many seconds along key cameras, with equal times from key to key.

    Places lie on a curve through those of the keys that does not overshoot, rotations on a spline without jumps of
    the angular velocity. All have the lens of the first key. Raises SurveyError for fewer than two keys.
    """
    if len(keys) < 2:
        raise SurveyError(f"a video needs two cameras at least, got {len(keys)}; give more in --cameras")
    times = np.linspace(0.0, seconds, max(round(seconds * FRAMES_PER_S), 2))
    of_keys = np.linspace(0.0, seconds, len(keys))
    centres = PchipInterpolator(of_keys, [key.centre for key in keys])(times)
    rotations = RotationSpline(of_keys, Rotation.from_matrix([key.cam_from_local for key in keys]))(times).as_matrix()
    # Codecs halve the resolution of colours: sides are even.
    first = replace(keys[0], motion=None, width=keys[0].width // 2 * 2, height=keys[0].height // 2 * 2)
    poses = zip(centres, rotations, strict=True)
    return [replace(first, centre=centre, cam_from_local=rotation) for centre, rotation in poses]


def write_video(path: Path, cameras: Sequence[PinholeCamera], view_of: Callable[[PinholeCamera], NovelView]) -> Path:
    """Render cameras into an MP4 (MPEG-4 part 2), whole or not at all; black where nothing is seen."""
    with TemporaryDirectory(prefix="bathynerf-video-") as scratch, current().stage("Render", len(cameras)) as stage:
        part = Path(scratch) / path.name
        size = cameras[0].width, cameras[0].height
        video = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), FRAMES_PER_S, size)
        for camera in cameras:
            view = view_of(camera)
            video.write(np.where(view.coloured[..., None], view.rgb, 0).astype(np.uint8)[..., ::-1])
            stage.advance()
        video.release()
        # OpenCV says neither that it cannot encode nor that a disk is full.
        written = cv2.VideoCapture(str(part)).get(cv2.CAP_PROP_FRAME_COUNT)
        if written != len(cameras):
            raise OutputError(f"OpenCV put {written:.0f} of {len(cameras)} pictures into {scratch}; free space there")
        path.parent.mkdir(parents=True, exist_ok=True)
        with write_whole(path) as stream:
            stream.write(part.read_bytes())
    return path
