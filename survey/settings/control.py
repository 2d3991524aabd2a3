"""[control] of survey.toml: points of known coordinates, their marks, check points, and an earlier survey."""

from __future__ import annotations

from dataclasses import dataclass

from survey.errors import ConfigError
from survey.files.toml_table import key
from survey.settings.std import require_std

# Of a point measured by GNSS with corrections or by a total station; of a mark set by hand.
DEFAULT_STD_M, DEFAULT_MARKS_STD_PX = 0.01, 0.5


@dataclass(frozen=True)
class ControlConfig:
    """[control]: files of control and check points, and how well they are known."""

    gcps: str | tuple[str, ...] | None = key(None, 'a file, e.g. "gcp_list.txt", or a list of files')
    checkpoints: str | None = None  # CSV of points that are only reported: name, easting, northing, height
    std_m: float | tuple[float, float] | None = key(None, "one number or [horizontal, vertical] in metres")
    marks: str | None = None  # where photographs show the points, unless gcps says it: a CSV, or Metashape's XML
    marks_std_px: float | None = None
    reference: str | None = None  # an earlier survey, on whose dry ground the block is placed: cloud, mesh or GeoTIFF
    reference_std_m: float | tuple[float, float] | None = key(None, "one number or [horizontal, vertical] in metres")
    stable: str | None = None  # GeoJSON or GeoPackage: polygons of its ground that did not change

    def __post_init__(self):
        if self.gcps == ():
            raise ConfigError("[control] gcps is an empty list, expected one file or more; name one or remove the key")
        if self.marks is not None and self.gcps is None:
            raise ConfigError(
                "[control] marks is given without gcps; name the file of the points' coordinates in gcps too"
            )
        require_std("[control] std_m", self.std_m, 10.0, "metres", "GNSS with corrections has about 0.01 to 0.03")
        if self.reference is None and (self.reference_std_m is not None or self.stable is not None):
            raise ConfigError(
                "[control] reference_std_m and stable say more of a reference, and there is none; name its file in "
                "reference, or remove them"
            )
        require_std("[control] reference_std_m", self.reference_std_m, 10.0, "metres", "airborne lidar has about 0.1")
        require_std("[control] marks_std_px", self.marks_std_px, 50.0, "pixels", "marks set by hand have about 0.5")

    @property
    def gcp_files(self) -> tuple[str, ...]:
        """The names in ``gcps``, none where it is missing."""
        if self.gcps is None:
            return ()
        return self.gcps if isinstance(self.gcps, tuple) else (self.gcps,)

    @property
    def files(self) -> tuple[str, ...]:
        """All files that the table names."""
        named = (self.marks, self.checkpoints, self.reference, self.stable)
        return (*self.gcp_files, *(name for name in named if name is not None))


def per_direction(std_m: float | tuple[float, float] | None) -> tuple[float, float, float]:
    """The standard deviations of control east, north and up [m].

    Raises
    ------
    ValueError
        If it is not known yet.
    """
    if std_m is None:
        raise ValueError("[control] std_m is not filled in; expected what `find_control` returns")
    return (std_m[0], std_m[0], std_m[1]) if isinstance(std_m, tuple) else (std_m, std_m, std_m)
