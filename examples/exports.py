"""Draw a survey of a cove, and write it as a drone, Metashape, OpenDroneMap and COLMAP do.

    python examples/exports.py FOLDER

FOLDER/photographs: a drone's photographs alone, with RTK positions in EXIF and XMP. metashape: with cameras.xml.
odm: with the project folder of OpenDroneMap. colmap: with a model in metres, binary; colmap-text: the same as text.
The poses are those of COLMAP's structure from motion on these photographs, with straight rays as in all three programs,
aligned to the positions. The water level is 584.2 m in DHHN2016; truth/ has the bed. Existing photographs are kept.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from PIL import Image
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation

from geo.crs import parse_crs
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from survey.photos.exif import read_exif
from survey.simulate.drawn import DrawnScene, draw_survey

SCENE = DrawnScene(shore=True, num_views=18, seed=4, size_m=(10.0, 9.0), depth_m=2.2)
_RTK_STD_M = 0.02
_XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RtkFlag="50" '
    f'drone-dji:RtkStdLon="{_RTK_STD_M}" drone-dji:RtkStdLat="{_RTK_STD_M}" drone-dji:RtkStdHgt="{_RTK_STD_M}"/>'
    "</rdf:RDF></x:xmpmeta>"
)
# Metres per unit of the chunk of Metashape, whose scale is arbitrary.
_CHUNK_SCALE = 12.354


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    draw_photographs(folder)
    block = aligned_block(folder / "photographs" / "images")
    for name, write in WRITERS.items():
        shutil.rmtree(folder / name, ignore_errors=True)
        shutil.copytree(folder / "photographs" / "images", folder / name / "images")
        write(folder / name, block)


def draw_photographs(folder: Path) -> None:
    """Draw the photographs into FOLDER/photographs/images, with GPS positions to 2 cm, and FOLDER/truth."""
    drawn, images = folder / "drawn", folder / "photographs" / "images"
    if images.exists():
        return
    draw_survey(drawn, SCENE)
    images.mkdir(parents=True)
    for path in sorted((drawn / "images").iterdir()):
        with Image.open(path) as image:
            image.convert("RGB").save(
                images / f"DJI_{path.stem}.JPG", quality=95, subsampling=0, exif=image.getexif(), xmp=_XMP.encode()
            )
    (drawn / "truth").rename(folder / "truth")
    shutil.rmtree(drawn)


def frame() -> LocalFrame:
    return LocalFrame(parse_crs(SCENE.crs), (*SCENE.origin, SCENE.level_m))


def aligned_block(images: Path) -> pycolmap.Reconstruction:
    """COLMAP's own poses, aligned by a similarity to the positions in EXIF: metres east, north and up of the origin."""
    names = sorted(path.name for path in images.iterdir())
    with tempfile.TemporaryDirectory() as work:
        database = Path(work, "database.db")
        reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
        pycolmap.set_random_seed(1)
        pycolmap.extract_features(database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader)
        pycolmap.match_exhaustive(database)
        blocks = pycolmap.incremental_mapping(database, images, work)
    block = max(blocks.values(), key=lambda block: block.num_reg_images())
    lat, lon, height = np.array([read_exif(images / name).lat_lon_height for name in names]).T
    east, north = Transformer.from_crs("EPSG:4326", CRS(SCENE.crs).sub_crs_list[0]).transform(lat, lon)
    places = frame().local_from_crs(np.column_stack([east, north, height]))
    ransac = pycolmap.RANSACOptions(max_error=0.5)
    local_from_block = pycolmap.align_reconstruction_to_locations(block, names, places, 3, ransac)
    block.transform(local_from_block)
    return block


def write_colmap(folder: Path, block: pycolmap.Reconstruction) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    block.write_binary(model)


def write_colmap_text(folder: Path, block: pycolmap.Reconstruction) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    block.write_text(model)


def write_metashape(folder: Path, block: pycolmap.Reconstruction) -> None:
    """cameras.xml of File > Export > Export Cameras, of a chunk in WGS 84 with the accuracies of its positions."""
    lon, lat, height = origin()
    ecef_from_local, ecef = geocentric(lon, lat, height)
    camera = one_camera(block)
    fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
    size = f'<resolution width="{camera.width}" height="{camera.height}"/>'
    values = {
        "f": fy, "cx": cx - camera.width / 2, "cy": cy - camera.height / 2, "b1": fx - fy, "k1": k1, "k2": k2,
        "p1": p2, "p2": p1,
    }  # fmt: skip
    lens = "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in values.items())
    cameras = []
    for number, image in enumerate(images_of(block)):
        pose = image.cam_from_world()
        chunk_from_cam = np.eye(4)
        chunk_from_cam[:3, :3] = pose.rotation.matrix().T
        chunk_from_cam[:3, 3] = image.projection_center() / _CHUNK_SCALE
        y, x, z = read_exif(folder / "images" / image.name).lat_lon_height
        cameras.append(
            f'<camera id="{number}" sensor_id="0" component_id="0" label="{image.name.partition(".")[0]}">'
            f"<transform>{numbers(chunk_from_cam)}</transform><orientation>1</orientation>"
            f'<reference x="{x!r}" y="{y!r}" z="{z!r}" sxyz="{_RTK_STD_M}" enabled="true"/></camera>'
        )
    wkt = CRS("EPSG:4326").to_wkt("WKT1_GDAL").replace('"', "&quot;")
    (folder / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0"><chunk label="Chunk 1" enabled="true">\n'
        f'<sensors next_id="1"><sensor id="0" label="FC6310R" type="frame">{size}'
        f'<calibration type="frame" class="adjusted">{size}{lens}</calibration></sensor></sensors>\n'
        '<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>'
        f"<rotation>{numbers(ecef_from_local)}</rotation><translation>{numbers(ecef)}</translation>"
        f"<scale>{_CHUNK_SCALE}</scale></transform></component></components>\n"
        f"<cameras next_id='{len(cameras)}' next_group_id='0'>\n" + "\n".join(cameras) + "\n</cameras>\n"
        f"<reference>{wkt}</reference></chunk></document>\n"
    )


def write_odm(folder: Path, block: pycolmap.Reconstruction) -> None:
    """Those parts of a project folder that bathynerf reads: opensfm/ with the topocentric block, origin and tracks."""
    opensfm = folder / "opensfm"
    opensfm.mkdir()
    lon, lat, height = origin()
    camera = one_camera(block)
    fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
    longer = max(camera.width, camera.height)
    middle = np.array([camera.width, camera.height]) / 2
    lens = {
        "projection_type": "brown", "width": camera.width, "height": camera.height, "focal_x": fx / longer,
        "focal_y": fy / longer, "c_x": (cx - middle[0]) / longer, "c_y": (cy - middle[1]) / longer,
        "k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": 0.0,
    }  # fmt: skip
    shots, tracks = {}, ["OPENSFM_TRACKS_VERSION_v2"]
    for image in images_of(block):
        pose = image.cam_from_world()
        shots[image.name] = {
            "rotation": Rotation.from_matrix(pose.rotation.matrix()).as_rotvec().tolist(),
            "translation": pose.translation.tolist(), "camera": "v2 dji", "orientation": 1,
        }  # fmt: skip
        for number, point in enumerate(image.points2D):
            if point.has_point3D():
                u, v = ((point.xy - middle) / longer).tolist()
                tracks.append(f"{image.name}\t{point.point3D_id}\t{number}\t{u!r}\t{v!r}\t0.001\t1\t2\t3\t-1\t-1")
    points = {str(i): {"coordinates": p.xyz.tolist(), "color": p.color.tolist()} for i, p in block.points3D.items()}
    made = [{"cameras": {"v2 dji": lens}, "shots": shots, "points": points}]
    (opensfm / "reconstruction.topocentric.json").write_text(json.dumps(made))
    (opensfm / "tracks.csv").write_text("\n".join([*tracks, ""]))
    (opensfm / "reference_lla.json").write_text(json.dumps({"latitude": lat, "longitude": lon, "altitude": height}))


WRITERS = {
    "metashape": write_metashape,
    "odm": write_odm,
    "colmap": write_colmap,
    "colmap-text": write_colmap_text,
}


def origin() -> tuple[float, float, float]:
    """Longitude, latitude [deg] and height of the zero point of the block."""
    lon, lat = lon_lat(frame().crs, np.array([SCENE.origin]))[0].tolist()
    return lon, lat, SCENE.level_m


def geocentric(lon: float, lat: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) from east, north and up to ECEF axes, and the position in ECEF (3,) [m]."""
    turn = Rotation.from_euler("ZY", [lon, -lat], degrees=True).as_matrix() @ np.eye(3)[[2, 0, 1]]
    place = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, height)
    return turn, np.array(place)


def one_camera(block: pycolmap.Reconstruction) -> pycolmap.Camera:
    (camera,) = block.cameras.values()
    return camera


def images_of(block: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    return sorted((image for image in block.images.values() if image.has_pose), key=lambda image: image.name)


def numbers(values: np.ndarray) -> str:
    return " ".join(f"{v:.17g}" for v in np.ravel(values))


if __name__ == "__main__":
    main()
