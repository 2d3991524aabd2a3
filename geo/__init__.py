"""Georeferencing: coordinate reference systems, the local frame, and files of clouds, meshes and terrain models.

| subject | files |
|---|---|
| coordinate reference systems and units | `crs`, `projection`, `transformation` |
| whether data sets and places fit together, and reprojection | `compatibility` |
| the local frame, and fitted transforms | `frames` |
| cells of rasters in plan | `grid` |
| clouds and meshes in memory | `shapes` |
| reading by the suffix of a name, with checks of the values | `reading` |
| formats | `las` (with `las_header`, `copc`), `ply`, `meshes` (OBJ, glTF), `e57`, `raster` |
| lines and areas | `features` (read), `vectors` (written) |
| files that are written whole or not at all, libraries of single formats | `files`; errors: `errors` |

A file, a CRS or a place at fault raises an error of `errors`, which names what was found and how to mend it; a function
says so only where that is not evident. Arrays that do not fit together raise ValueError.

The formats have no folder of their own: they need `crs`, `errors` and `files`, this file needs them, and no two folders
may import each other.
"""

# Part of bathynerf.

from geo.compatibility import crs_difference, require_same_crs, require_same_place
from geo.crs import parse_crs, wkt1
from geo.errors import GeoError
from geo.files import write_whole
from geo.frames import LocalFrame
from geo.las import read_cloud, write_cloud
from geo.ply import write_ply
from geo.reading import read_reference
from geo.shapes import Cloud, Mesh
