"""`bathynerf profile`: the profiles of a file of lines, and what is written of them."""

from __future__ import annotations

from pathlib import Path

from geo.lines import read_lines
from survey.files.outputs import ReadFiles, require_file
from survey.profile.profile import Bed, Profile
from survey.run.folder import RunDir

_PNG = b"\x89PNG"


def profiles_along(
    path: str | Path,
    lines: str | Path,
    *,
    step_m: float | None = None,
    reference: str | Path | None = None,
    csv_path: str | Path | None = None,
    picture_path: str | Path | None = None,
) -> list[Profile]:
    """Profiles of a run or a cloud along the lines of a file.

    Parameters
    ----------
    path : str or Path
        Run folder, LAS, LAZ or COPC.
    lines : str or Path
        GeoJSON, GeoPackage, shapefile or DXF; a DXF is in the CRS of the cloud.
    step_m : [m], optional
        Between places; by default some spacings of the points.
    reference : str or Path, optional
        Mesh, GeoTIFF or points.
    csv_path, picture_path : str or Path, optional
        Where the table and the picture go.

    Raises
    ------
    SurveyError, GeoError
        If a file cannot be read or written, or is of another place.
    """
    path, lines = Path(path), Path(lines)
    truth, table, picture = (None if each is None else Path(each) for each in (reference, csv_path, picture_path))
    read = ReadFiles.of(path if path.is_file() else None, lines, truth)
    if path.is_dir():
        read += RunDir(path).inputs()
    # A table that bathynerf wrote begins with its CRS.
    require_file("--csv", table, read, kind="a table of profiles", is_of_kind=lambda head: head[:2] in (b"# ", b""))
    require_file("--picture", picture, read, kind="a PNG", is_of_kind=lambda head: head[:4] in (_PNG, b""))
    bed = Bed(path, truth)
    found = [bed.along(line, step_m) for line in read_lines(lines, bed.crs)]
    if table is not None or picture is not None:
        from survey.profile.written import write_csv, write_picture

        if table is not None:
            write_csv(table, found)
        if picture is not None:
            write_picture(picture, found)
    return found
