"""Small files of control in every format, of the same three points in two photographs of the small survey."""

from pathlib import Path

from small_survey import CRS, E0, LEVEL, N0

from geo.crs import parse_crs
from survey.control.reading import merge_control, read_control

SIZES = {"a/0000.jpg": (64, 48), "a/0001.jpg": (64, 48), "a/0002.JPG": (64, 48)}
SURVEY_CRS = parse_crs(CRS)
POINTS = [("p1", E0, N0, LEVEL), ("p2", E0 + 4.25, N0 - 3.0, LEVEL + 0.5), ("p3", E0 + 1.0, N0 + 2.0, LEVEL + 1.0)]


def odm(points=POINTS, header: str = "EPSG:25832", images=("0000.jpg", "0001.jpg")) -> str:
    """gcp_list.txt with each point in each image, the first at 10, 20."""
    lines = [
        f"{e} {n} {h} {10 + i} {20 + j} {image} {name}"
        for i, (name, e, n, h) in enumerate(points)
        for j, image in enumerate(images)
    ]
    return "\n".join([header, *lines]) + "\n"


def table(points=POINTS, mark: str = ",", decimal: str = ".") -> str:
    lines = [mark.join([name, *(f"{v:.4f}".replace(".", decimal) for v in place)]) for name, *place in points]
    return "\n".join([mark.join(("name", "easting", "northing", "height")), *lines]) + "\n"


def marks(names=("p1", "p2", "p3"), images=("0000.jpg", "0001.jpg")) -> str:
    lines = [f"{image},{name},{10.5 + i},{20.5 + j}" for i, name in enumerate(names) for j, image in enumerate(images)]
    return "\n".join(["image,name,x,y", *lines]) + "\n"


METASHAPE = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors><sensor id="0" label="FC6310"/></sensors>
<cameras><camera id="7" sensor_id="0" label="0000"/><camera id="9" sensor_id="0" label="0001.jpg"/></cameras>
<markers>
<marker id="3" label="p1"><reference x="589012" y="5194736" z="2105" enabled="true"/></marker>
<marker id="4" label="p2"><reference x="589016.25" y="5194733" z="2105.5" sx="0.02" sy="0.03" sz="0.05"/></marker>
<marker id="5" label="p3"><reference x="589013" y="5194738" z="2106" enabled="false"/></marker>
<marker id="6" label="tie"/>
</markers>
<frames><frame id="0"><markers>
<marker marker_id="3"><location camera_id="7" x="10.5" y="20.5"/><location camera_id="9" x="10.5" y="21.5"/></marker>
<marker marker_id="4"><location camera_id="7" x="11.5" y="20.5"/><location camera_id="9" x="11.5" y="21.5"/></marker>
<marker marker_id="5"><location camera_id="7" x="12.5" y="20.5"/><location camera_id="9" x="12.5" y="21.5"/></marker>
<marker marker_id="6"><location camera_id="7" x="1" y="2"/></marker>
<marker marker_id="3"><location camera_id="7" pinned="false" x="60" y="40"/></marker>
</markers></frame></frames>
<reference></reference>
</chunk></document>
"""


def written(tmp_path, **files: str | bytes) -> list[Path]:
    """Files by their names, with __ for the dot."""
    paths = []
    for name, text in files.items():
        paths.append(tmp_path / name.replace("__", "."))
        paths[-1].write_bytes(text if isinstance(text, bytes) else text.encode())
    return paths


def gathered(paths, crs=SURVEY_CRS):
    found, said = merge_control([read_control(path) for path in paths], crs, SIZES)
    return found, list(said.assumptions), list(said.warnings)
