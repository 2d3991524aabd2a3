"""References: PLY and OBJ in full double precision, polygons cut, damage named."""

import os
import shutil
import struct
import subprocess

import numpy as np
import pytest
from pyproj import CRS

from geo.errors import UnreadableFile
from geo.ply import write_ply
from geo.reading import read_reference
from geo.shapes import Cloud, Mesh, triangulated

NORTHING = np.array([589012.0, 5194736.0, 2105.0])
CORNERS = NORTHING + np.array([[0.0, 0, 0], [1, 0, 0.0001234567], [1, 1, 0], [0, 1, 0], [0.5, 2.000001, 0]])
# A site grid, which no authority has a code for.
SITE = "+proj=tmerc +lat_0=48 +lon_0=10.3 +k=1 +x_0=1000 +y_0=2000 +ellps=GRS80"
TRIANGLES = [[0, 1, 2], [0, 2, 3]]
POLYGONS = [[0, 1, 2], [0, 2, 4, 3], [0, 1, 2, 4, 3]]
CUT = [[0, 1, 2], [0, 2, 4], [0, 4, 3], [0, 1, 2], [0, 2, 4], [0, 4, 3]]


def ply_bytes(faces, *, form="binary_little_endian", coordinate="double", extra=False, corners=CORNERS) -> bytes:
    """A PLY file of corners and faces; ``extra`` puts a further column and another element in the way."""
    order = ">" if form.endswith("big_endian") else "<"
    kind = {"double": "d", "float": "f"}[coordinate]
    lines = ["ply", f"format {form} 1.0", "comment made by hand", f"element vertex {len(corners)}"]
    lines += [f"property {coordinate} {axis}" for axis in "xyz"]
    lines += ["property uchar flag"] * extra + ["element camera 2", "property float f", "property short n"] * extra
    lines += [f"element face {len(faces)}"] + ["property int group"] * extra
    lines += ["property list uchar int vertex_indices"] + ["property list uchar float texcoord"] * extra
    rows = [[(kind, v) for v in corner] + [("B", 7)] * extra for corner in corners.tolist()]
    rows += [[("f", 2.5), ("h", -3)]] * (2 * extra)
    for face in faces:
        texture = [("B", 2), ("f", 0.5), ("f", 0.25)] * extra
        rows.append([("i", 9)] * extra + [("B", len(face))] + [("i", v) for v in face] + texture)
    head = ("\n".join([*lines, "end_header"]) + "\n").encode()
    if form == "ascii":
        return head + "".join(" ".join(repr(v) for _, v in row) + "\n" for row in rows).encode()
    return head + b"".join(struct.pack(order + k, v) for row in rows for k, v in row)


def obj_text(faces, words="{}") -> str:
    lines = ["# by hand", "mtllib none.mtl", *("v {!r} {!r} {!r}".format(*c) for c in CORNERS.tolist())]
    lines += ["vt 0 0", "vn 0 0 1", *("f " + " ".join(words.format(v + 1) for v in face) for face in faces)]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("extra", [False, True])
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(("faces", "expected"), [(TRIANGLES, TRIANGLES), (POLYGONS, CUT)])
def test_ply_meshes_are_read_to_the_last_bit_of_a_double(tmp_path, form, faces, expected, extra):
    (tmp_path / "m.ply").write_bytes(ply_bytes(faces, form=form, extra=extra))
    mesh = read_reference(tmp_path / "m.ply")
    assert isinstance(mesh, Mesh)
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, expected)


@pytest.mark.parametrize("words", ["{}", "{0}/1", "{0}/1/1", "{0}//1"])
@pytest.mark.parametrize(("faces", "expected"), [(TRIANGLES, TRIANGLES), (POLYGONS, CUT)])
def test_obj_meshes_are_read_to_the_last_bit_of_a_double(tmp_path, words, faces, expected):
    (tmp_path / "m.OBJ").write_text(obj_text(faces, words))
    mesh = read_reference(tmp_path / "m.OBJ")
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, expected)


def test_obj_faces_may_count_back_from_the_last_vertex_and_go_on_in_the_next_line(tmp_path):
    first, second = (obj_text([[0, 1, 2]]).split("vt")[0] for _ in range(2))
    (tmp_path / "m.obj").write_text(first + "f -5 -4 \\\n -3 # back\n" + second + "f -5/1 -4/1 -3/1\nf 1 2 3\n")
    mesh = read_reference(tmp_path / "m.obj")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [5, 6, 7], [0, 1, 2]])


def test_files_without_faces_are_clouds(tmp_path):
    (tmp_path / "c.ply").write_bytes(ply_bytes([]))
    (tmp_path / "c.obj").write_text(obj_text([]))
    for name in ("c.ply", "c.obj"):
        cloud = read_reference(tmp_path / name)
        assert isinstance(cloud, Cloud)
        np.testing.assert_array_equal(cloud.points, CORNERS)


def test_a_written_ply_cloud_comes_back_to_the_last_bit(tmp_path, rng):
    points = NORTHING + rng.uniform(-20.0, 20.0, (500, 3))
    rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    depth = rng.uniform(0, 4, 500)
    write_ply(tmp_path / "c.ply", points, rgb=rgb, scalars={"depth_m": depth, "std_m": depth / 100})
    cloud = read_reference(tmp_path / "c.ply")
    np.testing.assert_array_equal(cloud.points, points)
    np.testing.assert_array_equal(cloud.rgb, rgb)
    np.testing.assert_array_equal(cloud.extra["depth_m"], depth.astype(np.float32))
    assert list(cloud.extra) == ["depth_m", "std_m"]
    assert b"property double x\n" in (tmp_path / "c.ply").read_bytes()[:300]


def test_another_library_reads_the_written_ply_cloud_to_the_last_bit(tmp_path, rng):
    trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed: pip install 'bathynerf[gltf]'")
    points = NORTHING + rng.uniform(-20.0, 20.0, (500, 3))
    rgb = rng.integers(0, 256, (500, 3), dtype=np.uint8)
    write_ply(tmp_path / "c.ply", points, rgb=rgb, scalars={"depth_m": rng.uniform(0, 4, 500)})
    cloud = trimesh.load(tmp_path / "c.ply")
    np.testing.assert_array_equal(cloud.vertices, points)
    np.testing.assert_array_equal(cloud.colors[:, :3], rgb)
    faces = rng.integers(0, 500, (300, 3))
    write_ply(tmp_path / "m.ply", points, rgb=rgb, scalars={}, faces=faces)
    mesh = trimesh.load(tmp_path / "m.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, points)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], rgb)
    np.testing.assert_array_equal(read_reference(tmp_path / "m.ply").faces, faces)


def test_cloudcompare_shows_every_field_of_a_written_ply_cloud(tmp_path, rng):
    program = shutil.which("CloudCompare") or shutil.which("cloudcompare.CloudCompare")
    if program is None:
        pytest.skip("CloudCompare is not installed (Debian: apt-get install cloudcompare)")
    points = NORTHING + rng.uniform(-20.0, 20.0, (50, 3))
    depth = rng.uniform(0, 4, 50)
    scalars = {"depth_m": depth, "num_views": np.arange(50)}
    write_ply(tmp_path / "c.ply", points, rgb=np.zeros((50, 3), np.uint8), scalars=scalars, crs=CRS("EPSG:25832+5778"))
    command = ["-SILENT", "-AUTO_SAVE", "OFF", "-NO_TIMESTAMP", "-C_EXPORT_FMT", "ASC", "-PREC", "9", "-ADD_HEADER",
               "-O", "-GLOBAL_SHIFT", "AUTO", str(tmp_path / "c.ply"), "-SAVE_CLOUDS"]  # fmt: skip
    subprocess.run(
        [program, *command], env=os.environ | {"QT_QPA_PLATFORM": "offscreen"}, check=True, capture_output=True
    )
    head, *rows = (tmp_path / "c.asc").read_text().splitlines()
    assert head.split()[-2:] == ["depth_m", "num_views"]
    table = np.array([row.split() for row in rows[-50:]], dtype=float)
    np.testing.assert_allclose(table[:, :3], points, atol=1e-5)  # single precision after a shift
    np.testing.assert_allclose(table[:, -2], depth, rtol=1e-6)


@pytest.mark.parametrize(("crs", "words"), [("EPSG:25832+5778", [b"comment crs EPSG:25832+5778\n"]), (SITE, [])])
def test_the_header_of_a_written_ply_names_its_crs_in_lines_that_every_reader_takes(tmp_path, crs, words):
    write_ply(tmp_path / "c.ply", np.zeros((1, 3)), rgb=np.zeros((1, 3), np.uint8), scalars={}, crs=CRS(crs))
    lines = (tmp_path / "c.ply").read_bytes().split(b"end_header")[0].splitlines(keepends=True)
    assert [line for line in lines if line.startswith(b"comment crs ")] == words
    assert max(len(line) for line in lines) < 256
    if not words:
        parts = [line[16:-1].decode() for line in lines if line.startswith(b"comment crs_wkt ")]
        assert CRS.from_wkt("".join(parts)) == CRS(crs)


def test_a_ply_cloud_that_cannot_be_written_says_so(tmp_path):
    points, rgb = np.zeros((2, 3)), np.zeros((2, 3), np.uint8)
    for scalars, words in (
        ({"depth m": np.zeros(2)}, "cannot name a property"),
        ({"x": np.zeros(2)}, "cannot name a property"),
        ({"depth_m": np.zeros(3)}, r"depth_m has shape \(3,\), expected \(2,\)"),
    ):
        with pytest.raises(ValueError, match=words):
            write_ply(tmp_path / "c.ply", points, rgb=rgb, scalars=scalars)
    with pytest.raises(ValueError, match=r"expected points and colours \(N, 3\)"):
        write_ply(tmp_path / "c.ply", points, rgb=rgb[:1], scalars={})
    assert list(tmp_path.iterdir()) == []


def test_single_precision_is_refused_only_where_its_steps_are_coarse(tmp_path):
    (tmp_path / "m.ply").write_bytes(ply_bytes(TRIANGLES, coordinate="float"))
    with pytest.raises(UnreadableFile, match=r"m\.ply .*5194738 in single precision, with a resolution of 0\.5"):
        read_reference(tmp_path / "m.ply")
    near = CORNERS - NORTHING
    (tmp_path / "local.ply").write_bytes(ply_bytes(TRIANGLES, coordinate="float", corners=near))
    np.testing.assert_allclose(read_reference(tmp_path / "local.ply").vertices, near, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", [TRIANGLES, POLYGONS])
def test_every_cut_of_a_ply_file_is_an_error_that_names_it(tmp_path, form, faces):
    data = ply_bytes(faces, form=form)
    # A cut within the last word of ASCII leaves a shorter number, which nothing can tell.
    for size in range(0, len(data) - 4, 7):
        (tmp_path / "cut.ply").write_bytes(data[:size])
        with pytest.raises(UnreadableFile, match=r"cut\.ply cannot be read as PLY"):
            read_reference(tmp_path / "cut.ply")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("element vertex 5", "element vertex -5", 'the line "element vertex -5" of its header is not understood'),
        ("element vertex 5", "element vertex 1000000000000", "ends before the last of its 1000000000000 elements"),
        ("element vertex 5", "element knot 5", "no vertices with x, y and z"),
        ("property double x", "property quad x", 'the line "property quad x"'),
        ("format ascii 1.0", "format ebcdic 1.0", 'the line "format ebcdic 1.0"'),
        ("format ascii 1.0\n", "", "its header names no format"),
        ("element face 2", "element tristrips 2", "triangle strips; export it with a list of faces"),
        ("\n3 0 1 2", "\n3 0 1 x", "a word that is not a number"),
        ("\n3 0 1 2", "\n3 0 1 99", r"triangle 0\) that names a vertex beyond its 5"),
        ("\n3 0 1 2", "\n3 0 1 -1", r"triangle 0\) that names a vertex beyond its 5"),
        ("\n3 0 1 2", "\n-3 0 1 2", "it ends, or breaks, within its elements of kind face"),
        ("\n589012.0 5194736.0", "\nnan 5194736.0", "1 of 5 vertices whose coordinates are not finite"),
    ],
)
def test_damage_to_a_ply_file_is_named(tmp_path, old, new, words):
    text = ply_bytes(TRIANGLES, form="ascii").decode()
    assert old in text
    (tmp_path / "m.ply").write_text(text.replace(old, new, 1))
    with pytest.raises(UnreadableFile, match=rf"m\.ply .*{words}"):
        read_reference(tmp_path / "m.ply")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("v 589012.0 5194736.0 2105.0", "v 589012.0 5194736.0", "vertex line that is not three numbers"),
        ("v 589012.0", "v east", "vertex line that is not three numbers"),
        ("v 589012.0", "v inf", "1 of 5 vertices whose coordinates are not finite"),
        ("f 1 2 3", "f 1 2 three", "face line that is not whole numbers"),
        ("f 1 2 3", f"f 1 2 {'9' * 40}", "face line that is not whole numbers"),
        ("f 1 2 3", "f 1 2 6", r"triangle 0\) that names a vertex beyond its 5"),
        ("f 1 2 3", "f 0 1 2", r"triangle 0\) that names a vertex beyond its 5"),
        ("f 1 2 3", "f 1 -9 2", r"triangle 0\) that names a vertex beyond its 5"),
        ("f 1 2 3\nf 1 3 4", "f 1 2", "faces of fewer than three corners only"),
    ],
)
def test_damage_to_an_obj_file_is_named(tmp_path, old, new, words):
    text = obj_text(TRIANGLES)
    assert old in text
    (tmp_path / "m.obj").write_text(text.replace(old, new, 1))
    with pytest.raises(UnreadableFile, match=rf"m\.obj has .*{words}"):
        read_reference(tmp_path / "m.obj")


def test_paths_that_cannot_be_a_reference_are_named(tmp_path):
    with pytest.raises(UnreadableFile, match=r"none\.ply does not exist"):
        read_reference(tmp_path / "none.ply")
    (tmp_path / "m.stl").write_text("solid")
    with pytest.raises(UnreadableFile, match=r'the suffix "\.stl"; export it as one of \.ply, \.obj, \.las, \.laz'):
        read_reference(tmp_path / "m.stl")
    (tmp_path / "e.obj").write_text("# nothing\n")
    (tmp_path / "e.ply").write_bytes(ply_bytes([], form="ascii", corners=CORNERS[:0]))
    write_ply(tmp_path / "c.ply", np.empty((0, 3)), rgb=np.empty((0, 3), np.uint8), scalars={})
    for name in ("e.obj", "e.ply", "c.ply"):
        with pytest.raises(UnreadableFile, match=f"{name} has no points"):
            read_reference(tmp_path / name)


def test_fans_keep_the_area_the_winding_and_the_order_of_polygons():
    counts = np.array([3, 2, 5, 0, 4])
    triangles = triangulated(counts, np.arange(14))
    np.testing.assert_array_equal(triangles, [[0, 1, 2], [5, 6, 7], [5, 7, 8], [5, 8, 9], [10, 11, 12], [10, 12, 13]])
    angle = np.linspace(0.0, 2.0 * np.pi, 7)[:-1]
    hexagon = np.stack([np.cos(angle), np.sin(angle), np.zeros(6)], axis=-1)
    a, b, c = np.moveaxis(hexagon[triangulated(np.array([6]), np.arange(6))], 1, 0)
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(1.5 * np.sqrt(3.0), rel=1e-14)
    assert triangulated(np.zeros(0, int), np.zeros(0, int)).shape == (0, 3)


@pytest.mark.parametrize(("survey", "vertices", "faces"), [("quick", 102461, 202130), ("wreck_water", 448305, 892354)])
def test_true_surfaces_are_read_as_double_meshes(data_dir, survey, vertices, faces):
    mesh = read_reference(data_dir / survey / "reference.ply")
    assert (len(mesh.vertices), len(mesh.faces)) == (vertices, faces)
    # Single precision would leave northings in whole halves of a metre.
    assert len(np.unique(mesh.vertices[:, 1])) > 100
    visible = read_reference(data_dir / survey / "visible.ply")
    assert isinstance(visible, Cloud)
    low, high = mesh.vertices.min(axis=0) - 1e-6, mesh.vertices.max(axis=0) + 1e-6
    assert ((visible.points >= low) & (visible.points <= high)).all()


def test_a_real_obj_keeps_its_twelve_decimals(data_dir):
    mesh = read_reference(data_dir / "real/pyBathySfM/BathySfM_SampleData.obj")
    assert mesh.vertices.shape == (22, 3)
    assert mesh.vertices[0, 0] == 338418.550689697266


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_of_a_property_that_a_ply_names_twice_the_last_one_counts(tmp_path, form):
    names = "".join(f"property double {name}\n" for name in ("x", "y", "z", "z"))
    head = f"ply\nformat {form} 1.0\nelement vertex 2\n{names}end_header\n".encode()
    rows = np.array([[1.0, 2.0, 3.0, 7.0], [4.0, 5.0, 6.0, 8.0]])
    body = " ".join(map(str, rows.ravel())).encode() if form == "ascii" else rows.tobytes()
    (tmp_path / "c.ply").write_bytes(head + body)
    np.testing.assert_array_equal(read_reference(tmp_path / "c.ply").points, rows[:, [0, 1, 3]])
