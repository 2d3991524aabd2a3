"""Errors in the user's coordinates and files; each message says how to fix it."""


class GeoError(ValueError):
    """An error that the user can fix: a CRS, an origin or a file. The command line ends with exit code 2."""


class PlaceMismatch(GeoError):
    """A position, or a data set as a whole, is not where it should be."""


class UnreadableFile(GeoError):
    """A file is missing, empty, cut short, or not of the type its name implies."""


class UnwritableFile(GeoError):
    """A file could not be written: no room, no folder, no permission."""


class UnknownUnit(GeoError):
    """Nothing states the unit of heights."""


def first_line(error: BaseException) -> str:
    """What an error of a library says in its first line, or its kind."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:100]
