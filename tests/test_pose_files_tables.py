"""Tables and lines of poses: every order, separator and kind of angles, against a block with exact points."""

from functools import partial

import numpy as np
import pytest
from foreign_block import (
    CLOSE_PX,
    SIZE,
    draw_block,
    grid_at,
    in_utm,
    level_at,
    load,
    lon_lat_height,
    most_missed_px,
    opk_deg,
)
from scipy.spatial.transform import Rotation

from survey.errors import PosesError
from survey.folder.pose_priors import BY_FILE
from survey.photos.poses import enu_from_yaw_pitch_roll
from survey.pose_files import find_poses, read_poses


@pytest.fixture(scope="module")
def block():
    return draw_block()


def lens_toml(block) -> str:
    lens = block.lens
    numbers = [lens.k[0], lens.k[1], lens.p1, lens.p2, lens.k[2], 0.0, 0.0, 0.0]
    return (
        f'model = "FULL_OPENCV"\nsize_px = {list(SIZE)}\nfocal_px = [{lens.fx}, {lens.fy}]\n'
        f"principal_point_px = [{lens.cx}, {lens.cy}]\ndistortion = {numbers}"
    )


def ypr_deg(block, view: int, axes_at=level_at) -> np.ndarray:
    """Yaw, pitch, roll (3,) [deg] of an aircraft (forward, right, down) that carries the camera below it."""
    level_from_cam = (block.cams[view] @ axes_at(block.centres[view])).T
    # The image has forward above and right on the right: x of cam is right, y is backward, z is down.
    aircraft_from_cam = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    north_east_down = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    turn = north_east_down @ level_from_cam @ aircraft_from_cam.T
    return Rotation.from_matrix(turn).as_euler("ZYX", degrees=True)


def rows(block, angles, places=None) -> list[tuple]:
    places = in_utm(block.centres) if places is None else places
    return [(name, *places[i], *angles(block, i)) for i, name in enumerate(block.names)]


def table(header: str, lines, separator=",", decimal=".", columns=(0, 1, 2, 3, 4, 5, 6)) -> str:
    def text(value):
        return value if isinstance(value, str) else f"{value:.9f}".replace(".", decimal)

    return "\n".join([header, *(separator.join(text(line[i]) for i in columns) for line in lines), ""])


TABLES = {
    "comma": lambda block: table("image,easting,northing,height,omega,phi,kappa", rows(block, opk_deg)),
    "semicolon, decimal commas": lambda block: table(
        "Kappa;Phi;Omega;Z;Y;X;Filename", rows(block, opk_deg), ";", ",", (6, 5, 4, 3, 2, 1, 0)
    ),
    "tab, units": lambda block: table(
        "#Label\tX/Easting\tY/Northing\tZ/Altitude\tOmega (deg)\tPhi (deg)\tKappa (deg)", rows(block, opk_deg), "\t"
    ),
    "heights in feet": lambda block: table(
        "image,E [m],N [m],Z [ft],omega,phi,kappa", rows(block, opk_deg, in_utm(block.centres) / [1.0, 1.0, 0.3048])
    ),
    "yaw, pitch, roll": lambda block: table("photo,east,north,alt,yaw,pitch,roll", rows(block, ypr_deg)),
    "gimbal": lambda block: table(
        "file,x,y,z,gimbal_yaw,gimbal_pitch,gimbal_roll",
        rows(block, lambda b, i: ypr_deg(b, i) - np.array([0.0, 90.0, 0.0])),
    ),
    "longitude and latitude": lambda block: table(
        "name,longitude,latitude,height,yaw,pitch,roll", rows(block, ypr_deg, lon_lat_height(block.centres))
    ),
    "estimates of Metashape": lambda block: table(
        "#Label,X/Easting,Y/Northing,Z/Altitude,X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est",
        [(row[0], 1.0, 2.0, 3.0, *row[1:]) for row in rows(block, ypr_deg)],
        columns=range(10),
    ),
}  # fmt: skip


@pytest.mark.parametrize("write", TABLES.values(), ids=TABLES.keys())
def test_a_table_in_any_order_and_with_any_angles_gives_the_same_cameras(tmp_path, block, write):
    (tmp_path / "poses.csv").write_text(write(block))
    survey = load(tmp_path, block, "poses.csv", cameras=lens_toml(block))
    assert find_poses(tmp_path) == [tmp_path / "poses.csv"]
    assert most_missed_px(survey, block) < CLOSE_PX
    assert survey.provenance.tool is None


@pytest.mark.parametrize(
    "angles",
    [lambda b, i: opk_deg(b, i)[::-1], lambda b, i: -opk_deg(b, i),
     lambda b, i: opk_deg(b, i) + np.array([0.0, 0.0, 0.8])],
    ids=["order", "sign", "convergence"],
)  # fmt: skip
def test_wrong_axes_do_not_pass(tmp_path, block, angles):
    header = "image,easting,northing,height,omega,phi,kappa"
    (tmp_path / "poses.csv").write_text(table(header, rows(block, angles)))
    assert most_missed_px(load(tmp_path, block, "poses.csv", cameras=lens_toml(block)), block) > 1.0


def test_yaw_pitch_and_roll_turn_the_camera_as_they_are_described():
    down = enu_from_yaw_pitch_roll(0.0, 0.0, 0.0)
    # Columns: the right side, the lower side and the view of the image, in east, north, up.
    assert down.transpose() == pytest.approx(np.array([[1, 0, 0], [0, -1, 0], [0, 0, -1]]))
    to_the_east = enu_from_yaw_pitch_roll(np.pi / 2, 0.0, 0.0)
    assert -to_the_east[:, 1] == pytest.approx([1, 0, 0])
    assert enu_from_yaw_pitch_roll(0.0, np.pi / 2, 0.0)[:, 2] == pytest.approx([0, 1, 0])
    assert enu_from_yaw_pitch_roll(0.0, 0.0, 0.1)[2, 0] < 0.0


def test_the_accuracy_of_positions_goes_into_the_adjustment(tmp_path, block):
    lines = [(*row, 0.02, 0.03, 0.05) for row in rows(block, opk_deg)]
    header = "image,easting,northing,height,omega,phi,kappa,std_east,std_north,std_height"
    (tmp_path / "poses.csv").write_text(table(header, lines, columns=range(10)))
    survey = load(tmp_path, block, "poses.csv", cameras=lens_toml(block))
    for view in survey.views:
        prior = survey.observations.priors[view.name]
        assert (prior.source, prior.position_std.tolist()) == (BY_FILE, [0.02, 0.03, 0.05])
        assert prior.position == pytest.approx(view.camera.centre, abs=1e-9)


def metashape_opk(block, names=None) -> str:
    lines = [f"# Cameras ({len(block.names)})"]
    lines.append("# PhotoID, X, Y, Z, Omega, Phi, Kappa, r11, r12, r13, r21, r22, r23, r31, r32, r33")
    for i, (name, *values) in enumerate(rows(block, opk_deg)):
        # From the grid into photo axes: x right, y up, z back.
        matrix = np.diag([1.0, -1.0, -1.0]) @ block.cams[i] @ grid_at(block.centres[i])
        numbers = [f"{v:.16f}" for v in (*values, *matrix.ravel())]
        lines.append("\t".join([names[i] if names else name, *numbers]))
    return "\n".join([*lines, ""])


TEXTS = {
    "Metashape": lambda block: metashape_opk(block),
    "names with spaces": lambda block: metashape_opk(block, [f"my {name}" for name in block.names]),
    "no heading": lambda block: table("", rows(block, opk_deg), "  "),
    "numbered": lambda block: table(
        "No Image X Y Z Omega Phi Kappa", [(str(i), *row) for i, row in enumerate(rows(block, opk_deg), 1)], " ",
        columns=range(8),
    ),
    "heading in another order": lambda block: table(
        "image\tz\ty\tx\tkappa\tphi\tomega", rows(block, opk_deg), "\t", columns=(0, 3, 2, 1, 6, 5, 4)
    ),
    "gon": lambda block: table(
        "# image x y z omega phi kappa in gon", rows(block, lambda b, i: opk_deg(b, i) / 0.9), "   "
    ),
}  # fmt: skip


@pytest.mark.parametrize("write", TEXTS.values(), ids=TEXTS.keys())
def test_lines_of_text_give_the_same_cameras(tmp_path, block, write):
    text = write(block)
    (tmp_path / "exterior.txt").write_text(text)
    if "my 0" in text:
        block = type(block)(tuple(f"my {n}" for n in block.names), block.centres, block.cams, block.points, block.lens)
    survey = load(tmp_path, block, "exterior.txt", cameras=lens_toml(block))
    # A table is known by its suffix where it is found, and by its heading where it is named.
    is_found = "mega" in text and not text.startswith("image\t")
    assert find_poses(tmp_path) == ([tmp_path / "exterior.txt"] if is_found else [])
    assert most_missed_px(survey, block) < CLOSE_PX
    assert survey.provenance.tool == ("Metashape" if "PhotoID" in text else None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a.jpg 1 2 3 4 5 6\na.jpg 1 2 3 4 5 6\n", "line 2: image a.jpg has a second pose"),
        ("a.jpg 1 2 3 4 5 6\nb.jpg 1 2 3 4 5\n", 'line 2: "b.jpg 1 2 3 4 5" was found, expected name, x, y'),
        ("a.jpg 1 2 3 4 5 6\nb.jpg 1 2 3 4 5 nan\n", "line 2: .* was found"),
        ("a.jpg 1 2 3 4 5 6\nb.jpg 1 2 3 4 5 " + "9" * 10_000, "line 2: .* was found"),
        ("a.jpg 1 2 3 4 5 390\n", "line 1: the angles are 4, 5, 390, expected degrees"),
        (
            "# PhotoID, X, Y, Z, Omega, Phi, Kappa\na.jpg\t1\t2\t3\t0\t0\t90" + "\t1\t0\t0\t0\t1\t0\t0\t0\t1",
            "line 2: the nine numbers",
        ),
        ("EPSG:32632\na.jpg 1 2 3 4 5 6\n", "begins with a CRS, as OpenDroneMap's geo.txt does"),
    ],
)
def test_a_spoilt_text_is_refused_with_its_line(tmp_path, text, words):
    (tmp_path / "exterior.txt").write_text(text)
    with pytest.raises(PosesError, match=words):
        read_poses(tmp_path / "exterior.txt")


@pytest.mark.parametrize("text", ["EPSG:32632\n1.0 2.0 3.0 10 20 a.jpg p1\n", "name x y\n", "", "\0\0"])
def test_other_texts_are_no_poses(tmp_path, text):
    (tmp_path / "gcp_list.txt").write_text(text)
    assert find_poses(tmp_path) == []
    with pytest.raises(PosesError, match="is not a known kind of poses file"):
        read_poses(tmp_path / "gcp_list.txt")


@pytest.mark.parametrize(
    ("header", "angles", "unit", "words"),
    [
        ("image,x,y,z,yaw,pitch,roll", lambda b, i: ypr_deg(b, i) - np.array([0.0, 90.0, 0.0]), 1.0,
         r"the pitch is -\d+ degrees .* call the columns gimbal_yaw"),
        ("image,x_ft,y_ft,z_m,omega,phi,kappa", opk_deg, 0.3048, "eastings and northings are in units of 0.3048"),
    ],
)  # fmt: skip
def test_columns_that_say_what_their_values_contradict_are_refused(tmp_path, block, header, angles, unit, words):
    lines = rows(block, angles, in_utm(block.centres) / [unit, unit, 1.0])
    (tmp_path / "poses.csv").write_text(table(header, lines))
    with pytest.raises(PosesError, match=words):
        load(tmp_path, block, "poses.csv", cameras=lens_toml(block))


@pytest.mark.parametrize("header", ["#name,x,y,alt,heading,pitch,roll", "#Name,X,Y,Z,Heading,Pitch,Roll"])
def test_the_heading_of_realitycapture_counts_from_grid_north(tmp_path, block, header):
    (tmp_path / "cameras.csv").write_text(table(header, rows(block, partial(ypr_deg, axes_at=grid_at))))
    survey = load(tmp_path, block, "cameras.csv", cameras=lens_toml(block))
    assert most_missed_px(survey, block) < CLOSE_PX
    assert any("counts from grid north, as RealityCapture writes it" in note for note in survey.findings.assumptions)
    other = header.replace("#name", "image").replace("#Name", "image")
    (tmp_path / "cameras.csv").write_text(table(other, rows(block, ypr_deg)))
    assert most_missed_px(load(tmp_path, block, "cameras.csv", cameras=lens_toml(block)), block) < CLOSE_PX
