"""Files of others under every suffix that is read: content of another format is refused, what it names is not read."""

import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
import rasterio

from geo.errors import GeoError
from geo.features import SUFFIXES as VECTORS
from geo.features import read_features
from geo.reading import _READERS as SURFACES
from geo.reading import read_reference
from survey.errors import SurveyError
from survey.photos.exif import SUFFIXES as PHOTOGRAPHS
from survey.photos.pixels import open_image

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def asked():
    """What a server on this machine is asked for, and its address."""
    paths: list[str] = []

    class Answer(BaseHTTPRequestHandler):
        def do_GET(self):
            paths.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *_given):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Answer) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        yield paths, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def write_raster(path: Path, value: float = 1.0) -> None:
    form = {"width": 4, "height": 4, "count": 1, "dtype": "float32", "crs": "EPSG:25832"}
    with rasterio.open(path, "w", driver="GTiff", transform=rasterio.Affine(1, 0, 5e5, 0, -1, 5e6), **form) as raster:
        raster.write(np.full((1, 4, 4), value, dtype=np.float32))


def vrt(source: str) -> str:
    """A virtual raster of another one."""
    return (
        '<VRTDataset rasterXSize="4" rasterYSize="4"><SRS>EPSG:25832</SRS><GeoTransform>5e5,1,0,5e6,0,-1</GeoTransform>'
        f'<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename>{source}</SourceFilename>'
        "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )


def ogr_vrt(source: str) -> str:
    return (
        f'<OGRVRTDataSource><OGRVRTLayer name="line"><SrcDataSource>{source}</SrcDataSource></OGRVRTLayer>'
        "</OGRVRTDataSource>"
    )


def foreign_contents(folder: Path, url: str) -> dict[str, bytes]:
    """Content that libraries of formats take for something, by name; all of it names a file in a folder or a URL."""
    write_raster(folder / "secret.tiff")
    (folder / "secret.geojson").write_text('{"type": "Point", "coordinates": [5e5, 5e6]}')
    named = {
        "VRT of a file": vrt(str(folder / "secret.tiff")),
        "VRT of a URL": vrt(f"/vsicurl/{url}/a.tif"),
        "WMS": f'<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/${{z}}</ServerUrl></Service></GDAL_WMS>',
        "OGR VRT of a file": ogr_vrt(str(folder / "secret.geojson")),
        "OGR VRT of a URL": ogr_vrt(f"/vsicurl/{url}/a.geojson"),
        "OGR VRT in a DXF": f"999\n{ogr_vrt(str(folder / 'secret.geojson'))}\n0\nSECTION\n2\nENTITIES\n0\nENDSEC",
        "WFS": f"<OGRWFSDataSource><URL>{url}/?</URL></OGRWFSDataSource>",
        "CSW": f"<OGRCSWDataSource><URL>{url}/?</URL></OGRCSWDataSource>",
        "GML": f'<a xmlns:gml="http://www.opengis.net/gml" xsi:schemaLocation="a {url}/a.xsd"><gml:x/></a>',
        "SVG": f'<svg xmlns="http://www.w3.org/2000/svg"><image href="{url}/a.png"/></svg>',
        "entity": f'<!DOCTYPE a [<!ENTITY b SYSTEM "{url}/b">]><a>&b;</a>',
        "playlist": f"#EXTM3U\n{url}/a\n",
        "EPS": "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n(x) (w) file closefile showpage\n",
        "PNM": "P3 1 1 255 1 2 3\n",
        "XPM": '/* XPM */ static char *a[] = {"1 1 1 1", "a c #000000", "a"};',
        "grid": "ncols 1\nnrows 1\nxllcorner 0\nyllcorner 0\ncellsize 1\n5\n",
        "glTF": f'{{"asset": {{"version": "2.0"}}, "buffers": [{{"uri": "{url}/a.bin", "byteLength": 36}}]}}',
    }
    return {name: text.encode() for name, text in named.items()}


def read_photograph(path: Path) -> None:
    with open_image(path) as image:
        image.load()


READERS = [
    *((suffix, read_reference) for suffix in SURFACES),
    *((suffix, lambda path: read_features(path, "lines")) for suffix in VECTORS),
    *((suffix, read_photograph) for suffix in PHOTOGRAPHS),
]


@pytest.mark.parametrize(("suffix", "read"), READERS, ids=[f"{read.__name__}-{suffix}" for suffix, read in READERS])
def test_content_of_another_format_is_refused_and_what_it_names_is_not_read(tmp_path, asked, suffix, read):
    paths, url = asked
    # GDAL asks for an address once.
    for name, content in foreign_contents(tmp_path, f"{url}/{suffix}/{tmp_path.name}").items():
        path = tmp_path / f"file{suffix}"
        path.write_bytes(content)
        with pytest.raises((GeoError, SurveyError), match=r"file\.") as refused:
            read(path)
        assert len(str(refused.value)) < 500, name
    assert paths == []


@pytest.mark.parametrize("source", ["secret.tiff", "/vsicurl/URL"])
@pytest.mark.parametrize("beside", [".msk", ".ovr", ".aux.xml"])
def test_a_file_beside_a_raster_brings_no_other_file(tmp_path, asked, beside, source):
    paths, url = asked
    write_raster(tmp_path / "secret.tiff", 0.0)
    write_raster(tmp_path / "a.tif", 7.0)
    named = source.replace("URL", f"{url}{tmp_path}/a.tif") if source.startswith("/") else str(tmp_path / source)
    content = vrt(named)
    if beside == ".aux.xml":
        content = (
            f'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">{named}</MDI></Metadata></PAMDataset>'
        )
    Path(f"{tmp_path / 'a.tif'}{beside}").write_text(content)
    assert read_reference(tmp_path / "a.tif").vertices[:, 2].tolist() == [7.0] * 16
    assert paths == []


def test_every_raster_and_vector_of_others_comes_by_the_one_door():
    """What `geo.raster` and `geo.vectors` open they have just written."""
    openers = r"\b(rasterio\.open|pyogrio\.read|pyogrio\.raw\.read|Image\.open|cv2\.imread|list_layers)\("
    opened = {
        (path.relative_to(ROOT).as_posix(), call)
        for room in ("geo", "survey", "evaluation", "fields", "refract", "bathynerf")
        for path in (ROOT / room).rglob("*.py")
        for call in re.findall(openers, path.read_text(encoding="utf-8"))
    }
    assert opened == {
        ("geo/raster.py", "rasterio.open"),
        ("geo/features.py", "pyogrio.raw.read"),
        ("geo/features.py", "list_layers"),
        ("survey/photos/pixels.py", "Image.open"),
        ("survey/volume/options.py", "cv2.imread"),
    }
