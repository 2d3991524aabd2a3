"""Pix4D's calibrated cameras: two files that agree, an offset, a map."""

import numpy as np
import pytest
from foreign_block import CLOSE_PX, SIZE, draw_block, grid_at, in_utm, load, most_missed_px, opk_deg
from pyproj import CRS, Transformer

from survey.errors import PosesError
from survey.pose_files import find_poses, read_poses

OFFSET = np.array([589000.0, 5194000.0, 2000.0])
HEAD = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
tangential distortion [2x1]
camera position t [3x1]
camera rotation R [3x3]
camera model m = K [R|-Rt] X

"""
# Lines of an image whose rotation would overflow in its product with itself.
SPOILT_ROTATION = "520 0 320\n0 520 240\n0 0 1\n0 0 0\n0 0\n0 0 0\n1e300 0 0\n0 -1 0\n0 0 -1\n0001.jpg 640 480\n"
EXTERNAL, CAMERAS = "site_calibrated_external_camera_parameters.txt", "site_calibrated_camera_parameters.txt"


@pytest.fixture(scope="module")
def block():
    return draw_block()


def line(values) -> str:
    return " ".join(f"{v:.12f}" for v in np.ravel(values))


def write(folder, block, *, what=("external", "cameras", "offset", "map"), wkt="EPSG:25832"):
    folder.mkdir(parents=True, exist_ok=True)
    places = in_utm(block.centres)
    if "external" in what:
        rows = [f"{name} {line(places[i])} {line(opk_deg(block, i))}" for i, name in enumerate(block.names)]
        (folder / EXTERNAL).write_text("\n".join(["imageName X Y Z Omega Phi Kappa", *rows, ""]))
    if "cameras" in what:
        lens = block.lens
        matrix = [[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]]
        images = [
            "\n".join(
                [
                    f"{name} {SIZE[0]} {SIZE[1]}", *(line(row) for row in matrix), line(lens.k[:3]),
                    # T1 goes with 2 x y in x, T2 with r2 + 2 x2: OpenCV's p1 and p2.
                    line([lens.p1, lens.p2]), line(places[i] - OFFSET),
                    *(line(row) for row in block.cams[i] @ grid_at(block.centres[i])), "",
                ]
            )
            for i, name in enumerate(block.names)
        ]  # fmt: skip
        (folder / CAMERAS).write_text(HEAD + "".join(images))
    if "offset" in what:
        (folder / "site_offset.xyz").write_text(line(OFFSET) + "\n")
    if "map" in what:
        (folder / "site_wkt.prj").write_text(CRS(wkt).to_wkt("WKT1_ESRI"))


@pytest.mark.parametrize("where", [".", "params", "1_initial/params"])
def test_the_files_of_a_project_put_points_where_the_photographs_show_them(tmp_path, block, where):
    write(tmp_path / where, block)
    assert find_poses(tmp_path) == [tmp_path / where / EXTERNAL]
    survey = load(tmp_path, block, f"{where}/{EXTERNAL}")
    assert most_missed_px(survey, block) < CLOSE_PX
    assert survey.provenance.tool == "Pix4D"


def test_positions_less_the_offset_do_with_it_and_not_without(tmp_path, block):
    write(tmp_path, block, what=("cameras", "offset"))
    survey = load(tmp_path, block, CAMERAS)
    assert most_missed_px(survey, block) < CLOSE_PX
    (tmp_path / "site_offset.xyz").unlink()
    with pytest.raises(PosesError, match=r"lacks the offset in site_offset\.xyz; put that beside it"):
        read_poses(tmp_path / CAMERAS)


def test_a_map_other_than_that_of_the_survey_is_undone_with_its_convergence(tmp_path, block):
    write(tmp_path, block)
    survey = load(tmp_path, block, ".", crs="EPSG:25833+5778")
    # In zone 33 grid north lies 3.5 degrees west of north here, and 0.8 degrees east of it in the file.
    assert most_missed_px_in(survey, block, "EPSG:25833") < CLOSE_PX


def most_missed_px_in(survey, block, crs: str) -> float:
    places = in_utm(block.points)
    there = Transformer.from_crs("EPSG:25832", crs, always_xy=True)
    points = survey.frame.local_from_crs(np.column_stack([*there.transform(*places.T[:2]), places[:, 2]]))
    missed = [
        view.camera.project(points[block.seen(i)], None) - block.pixels(i)[block.seen(i)]
        for i, view in enumerate(survey.views)
    ]
    return float(np.abs(np.concatenate(missed)).max())


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        (EXTERNAL, "0001.jpg", "0000.jpg", "are not those of its rotation|image 0000.jpg has a second pose"),
        (EXTERNAL, "0001.jpg 5", "0001.jpg x5", "expected 6 finite numbers"),
        (EXTERNAL, "0001.jpg 5", "0001.jpg " + "9" * 10_000, "expected 6 finite numbers"),
        (CAMERAS, "camera model", "camera", 'has no line "camera model'),
        (CAMERAS, "0001.jpg 640", "0001.jpg -640", "expected a name, width and height"),
        (CAMERAS, "520.000000000000 0.000000000000", "520.0 7.0", "a camera without skew"),
        (CAMERAS, "520.0", "-520.0", "a focal length above zero"),
        (CAMERAS, "0000.jpg 640 480\n", "0000.jpg 640 480\n" + SPOILT_ROTATION, "are not a rotation"),
        (CAMERAS, "0001.jpg 640 480\n", "0001.jpg 640 480\n1 2 3\n", "expected 2 finite numbers|expected 3 finite"),
        ("site_wkt.prj", "PROJCS", "PROJ", "is not a known CRS"),
        ("site_offset.xyz", " ", " nan ", "expected 3 finite numbers"),
    ],
)
def test_a_spoilt_file_is_refused_in_one_sentence(tmp_path, block, file, old, new, words):
    write(tmp_path, block)
    path = tmp_path / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    if file == "site_offset.xyz":
        (tmp_path / EXTERNAL).unlink()
    with pytest.raises(PosesError, match=words):
        read_poses(tmp_path)
