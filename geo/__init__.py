"""Where on Earth: coordinate reference systems, the local frame, and the files that carry coordinates."""

from geo.compatibility import crs_difference, require_same_crs, require_same_place, same_crs
from geo.crs import parse_crs, wkt1
from geo.errors import GeoError
from geo.files import write_whole
from geo.frames import LocalFrame
from geo.las import read_cloud, write_cloud
from geo.ply import write_ply
from geo.reading import read_reference
from geo.shapes import Cloud, Mesh

__all__ = [
    "Cloud",
    "GeoError",
    "LocalFrame",
    "Mesh",
    "crs_difference",
    "parse_crs",
    "read_cloud",
    "read_reference",
    "require_same_crs",
    "require_same_place",
    "same_crs",
    "wkt1",
    "write_cloud",
    "write_ply",
    "write_whole",
]
