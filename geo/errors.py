"""Errors in the user's coordinates and files; each message says how to fix it."""

from __future__ import annotations


class GeoError(ValueError):
    """An error that the user can fix: a CRS, an origin or a file. The command line ends with exit code 2."""


class UnknownCRS(GeoError):
    """The text names no coordinate reference system known to PROJ."""


class MissingVerticalDatum(GeoError):
    """The CRS has no vertical part: it does not say from where heights are measured."""


class UnsupportedCRS(GeoError):
    """A CRS that is understood but cannot carry a survey: depths, westings, geocentric axes."""


class CRSMismatch(GeoError):
    """Two data sets are in different coordinate reference systems."""


class PlaceMismatch(GeoError):
    """A position, or a data set as a whole, is not where it should be."""


class UnreadableFile(GeoError):
    """A file is missing, cut short, or not of the type its name implies."""


class EmptyCloud(UnreadableFile):
    """A file that should have points has none."""


class UnwritableFile(GeoError):
    """A file could not be written: no room, no folder, no permission."""


class MissingGrid(GeoError):
    """A transformation between two datums needs a grid that PROJ does not have."""


class UnknownUnit(GeoError):
    """Nothing states the unit of heights."""


def first_line(error: BaseException) -> str:
    """What an error of a library says in its first line, or its kind."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:100]
