"""What a poses format offers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from survey.photos.cameras import Pose


@dataclass(frozen=True)
class Format:
    """A format of poses files.

    Attributes
    ----------
    name : str
        In a sentence: "expected ...".
    find : callable
        Files or folders of this format in a survey folder, best known places only.
    recognises : callable
        Whether a path, which exists, is of this format.
    read : callable
        The poses in such a path; raises PosesError.
    read_points : callable, optional
        Matched points (N, 3) [m], local, that came with the poses, and how many images see each (N,); raises
        PosesError.
    """

    name: str
    find: Callable[[Path], list[Path]]
    recognises: Callable[[Path], bool]
    read: Callable[[Path], list[Pose]]
    read_points: Callable[[Path], tuple[np.ndarray, np.ndarray]] | None = None
