"""Every product of `bathynerf export`, by the panel of its help and in its order; a new product is an entry here."""

from __future__ import annotations

from survey.export.product import Product

_EDITED = "as_computed"
_CELLS = ("crs", "resolution_m", "fill_m", _EDITED)
_TIFF, _VECTOR = (".tif", ".tiff"), (".geojson", ".gpkg")
_LINES = (*_VECTOR, ".dxf", ".zip")
_BY_GDAL = "GeoJSON, DXF (extra dxf), GPKG, zipped shapefile (extra vector)."
FAMILIES: dict[str, tuple[Product, ...]] = {
    "Points": (
        Product("las", (".las",), "clouds", ("crs", "no_bed", "tpu", _EDITED),
                "Points as LAS 1.4.", "bed.las"),
        Product("laz", (".laz",), "clouds", ("crs", "no_bed", "tpu", _EDITED),
                "Points as LAZ, LAS compressed.", "bed.laz --crs EPSG:4326"),
        Product("copc", (".copc.laz",), "clouds", ("crs", "no_bed", "tpu", _EDITED),
                "Points as cloud-optimised LAZ, from which readers fetch parts.", "bed.copc.laz"),
        Product("ply", (".ply",), "clouds", ("crs", _EDITED),
                "Points as binary PLY in double precision.", "bed.ply"),
        Product("e57", (".e57",), "clouds", ("crs", _EDITED),
                "Places and colours of the points as E57 (needs the extra e57).", "bed.e57"),
        Product("soundings", (".xyz", ".csv"), "soundings", ("crs", "resolution_m", "thin", _EDITED),
                "Points as XYZ or, with depth and standard deviations, CSV.", "bed.xyz --thin shoal"),
    ),
    "Rasters": (
        Product("dem", _TIFF, "terrain", _CELLS,
                "Heights as GeoTIFF: height, uncertainty, points, depth, origin.", "bed.tif --resolution 0.1"),
        Product("bag", (".bag",), "hydrography", _CELLS,
                "Heights and uncertainty as BAG (HDF5).", "bed.bag --resolution 0.5"),
        Product("s44", _TIFF, "hydrography", _CELLS,
                "Order of IHO S-44 by uncertainty, as GeoTIFF.", "orders.tif --resolution 1"),
        Product("orthophoto", _TIFF, "orthophoto", (*_CELLS, "survey"),
                "The bed from above, from the photographs, as GeoTIFF.", "bed.tif --fill 0.5"),
        Product("waves", ("",), "waves", (_EDITED,),
                "Folder: height of the water in each photograph, as GeoTIFF.", "waves", is_folder=True),
    ),
    "Meshes": (
        Product("mesh", (".ply", ".obj", ".glb"), "meshes",
                ("crs", "resolution_m", "mesh_method", "watertight", _EDITED),
                "The bed in coloured triangles: PLY, OBJ or GLB.", "bed.obj --watertight"),
    ),
    "Lines and areas": (
        Product("footprints", _VECTOR, "vectors", ("crs", _EDITED),
                "What each photograph shows of the bed: GeoJSON, GeoPackage (extra vector).", "images.geojson"),
        Product("shoreline", _LINES, "vectors", _CELLS,
                f"Where the bed meets the water: {_BY_GDAL}", "shore.gpkg --fill 0.5"),
        Product("contours", _LINES, "vectors", (*_CELLS, "interval_m"),
                f"Lines of equal depth: {_BY_GDAL}", "deep.dxf --interval 0.5"),
        Product("unseen", (*_VECTOR, *_TIFF), "unseen", _CELLS,
                "Where water was looked at and no bed found: polygons, or GeoTIFF in the cells of --dem.",
                "unseen.geojson"),
    ),
    "Cameras": (
        Product("colmap", ("",), "cameras", (_EDITED,),
                "Folder: cameras as a COLMAP model (text); rays bend at the water.", "sparse", is_folder=True),
        Product("nerfstudio", (".json",), "cameras", (),
                "Cameras as nerfstudio's transforms.json.", "cameras.json", is_of_points=False),
    ),
    "Documents": (
        Product("pdf", (".pdf",), "pdf", (),
                "report.html as PDF, A4 (by Chromium, Chrome or Edge).", "report.pdf", is_of_points=False),
    ),
}  # fmt: skip
PRODUCTS: tuple[Product, ...] = tuple(product for members in FAMILIES.values() for product in members)
