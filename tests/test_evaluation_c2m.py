"""Cloud to mesh: closed forms, an independent slow implementation, and the two ways to sign."""

import numpy as np
import pytest
from bench_compare import closest_on_triangles
from scipy.spatial import ConvexHull
from slow_cases import slow

from evaluation import distance_to_mesh, weld
from evaluation.c2m import num_inconsistent_edges

EPS = np.finfo(np.float64).eps
# Numbers of size 10 m go through some twenty operations each.
ROUNDING_M = 100 * 10 * EPS
# A northing of 5.2e6 m is a multiple of 9e-10 m; a nearest point moves by a few of them.
ROUNDING_UTM_M = 4 * 5.2e6 * EPS
UTM = np.array([589012.0, 5194736.0, 2105.0])
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
SQUARE_FACES = np.array([[0, 1, 2], [0, 2, 3]])


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A closed box around the origin, its faces counter-clockwise from outside."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))])


def _box_distance(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """The exact signed distance to a box, positive outside."""
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0.0), axis=1) + np.minimum(q.max(axis=1), 0.0)


def _soup(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same triangles, each with vertices of its own."""
    return vertices[faces.ravel()], np.arange(faces.size).reshape(-1, 3)


def _slow_distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Least distance to any edge and to any plane whose foot is in the triangle, one after the other."""
    best = np.full(len(points), np.inf)
    for a, b, c in vertices[faces]:
        for start, end in ((a, b), (b, c), (c, a)):
            along = end - start
            t = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
            best = np.minimum(best, np.linalg.norm(points - start - t[:, None] * along, axis=1))
        uv, *_ = np.linalg.lstsq(np.stack([b - a, c - a], axis=1), (points - a).T, rcond=None)
        inside = (uv >= 0.0).all(axis=0) & (uv.sum(axis=0) <= 1.0)
        foot = a + uv.T @ np.stack([b - a, c - a])
        best = np.where(inside, np.minimum(best, np.linalg.norm(points - foot, axis=1)), best)
    return best


def test_a_point_under_an_open_surface_is_negative_and_one_above_positive():
    points = np.array([[0.3, 0.2, -0.1], [0.3, 0.2, 0.1], [0.5, 0.1, 0.0]])
    result = distance_to_mesh(points, SQUARE, SQUARE_FACES)
    np.testing.assert_allclose(result.signed, [-0.1, 0.1, 0.0], atol=ROUNDING_M)
    np.testing.assert_allclose(result.nearest, points * [1, 1, 0], atol=ROUNDING_M)


@pytest.mark.parametrize("as_soup", [False, True])
def test_a_closed_box_signed_by_winding_is_its_exact_signed_distance(as_soup, rng):
    """Faces, edges and vertices, inside and outside: the sign at edges is where a careless one goes wrong."""
    half = np.array([1.0, 0.7, 0.2])
    vertices, faces = _soup(*_box(half)) if as_soup else _box(half)
    points = rng.uniform(-3, 3, (4000, 3)) * half
    result = distance_to_mesh(points, vertices, faces, sign="winding")
    np.testing.assert_allclose(result.signed, _box_distance(points, half), atol=ROUNDING_M)


def _convex(rng: np.random.Generator, size: list[float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A convex hull wound counter-clockwise from outside, and its planes (outward normal, offset)."""
    vertices = rng.normal(size=(60, 3)) * size
    hull = ConvexHull(vertices)
    faces = hull.simplices.copy()
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces, hull.equations


def test_inside_and_outside_of_a_convex_body_are_told_apart_at_every_edge_and_vertex(rng):
    vertices, faces, planes = _convex(rng, [3.0, 2.0, 1.5])
    points = rng.normal(size=(5000, 3)) * [5.0, 4.0, 3.0]
    height = (points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    signed = distance_to_mesh(points, vertices, faces, sign="winding").signed
    np.testing.assert_array_equal(signed > 0, height > 0)
    inside = height < 0
    assert inside.sum() > 100
    np.testing.assert_allclose(signed[inside], height[inside], atol=ROUNDING_M)


@pytest.mark.parametrize("sign", ["up", slow("winding")])
def test_among_equally_near_triangles_the_most_orthogonal_one_decides(sign, rng):
    """The rule of CloudCompare, taken literally over all pairs, on a body with edges like knives."""
    vertices, faces, _ = _convex(rng, [5.0, 1.0, 0.02])
    points = rng.normal(size=(60, 3)) * [10.0, 2.0, 0.1]
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if sign == "up":
        normals[normals[:, 2] < -0.05] *= -1.0
    expected = []
    for point in points:
        distances = np.array([_slow_distances(point[None], vertices, face[None])[0] for face in faces])
        nearest = [closest_on_triangles(point[None], vertices[face][None])[0] for face in faces]
        equal = np.flatnonzero(distances <= distances.min() * (1 + 1e-9))
        cos = np.array([(point - nearest[k]) @ normals[k] / distances[k] for k in equal])
        expected.append(cos[np.abs(cos).argmax()] >= 0)
    signed = distance_to_mesh(points, vertices, faces, sign=sign).signed
    np.testing.assert_array_equal(signed > 0, expected)


def test_distances_agree_with_a_slow_twin_on_random_triangles(rng):
    vertices = rng.normal(size=(90, 3)) * [3.0, 3.0, 1.0]
    faces = rng.integers(0, 90, (150, 3))
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    points = rng.normal(size=(800, 3)) * 4.0
    result = distance_to_mesh(points, vertices, faces)
    np.testing.assert_allclose(np.abs(result.signed), _slow_distances(points, vertices, faces), atol=ROUNDING_M)
    lengths = np.linalg.norm(points - result.nearest, axis=1)
    np.testing.assert_allclose(lengths, np.abs(result.signed), atol=ROUNDING_M)


def test_the_nearest_point_of_a_triangle_is_inside_on_an_edge_or_at_a_corner():
    corners = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    points = np.array([[1.0, 1, 3], [2, -1, 0], [3, 3, 1], [-1, 2, 0], [-1, -1, 0], [6, -1, 0], [-1, 6, 0]])
    expected = [[1, 1, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 0], [4, 0, 0], [0, 4, 0]]
    for found in (
        closest_on_triangles(points, np.broadcast_to(corners, (7, 3, 3))),
        distance_to_mesh(points, corners, np.array([[0, 1, 2]])).nearest,
    ):
        np.testing.assert_allclose(found, expected, atol=ROUNDING_M)


def test_coordinates_of_a_map_grid_cost_only_their_own_rounding(rng):
    half = np.array([1.0, 0.7, 0.2])
    vertices, faces = _box(half)
    points = rng.uniform(-3, 3, (2000, 3)) * half
    result = distance_to_mesh(points + UTM, vertices + UTM, faces, sign="winding")
    np.testing.assert_allclose(result.signed, _box_distance(points, half), atol=ROUNDING_UTM_M)
    lengths = np.linalg.norm(points + UTM - result.nearest, axis=1)
    np.testing.assert_allclose(lengths, np.abs(result.signed), atol=ROUNDING_UTM_M)


@pytest.mark.parametrize("reverse", [False, True])
def test_sign_up_does_not_depend_on_the_winding(reverse):
    faces = SQUARE_FACES[:, ::-1] if reverse else SQUARE_FACES
    points = np.array([[0.1, 0.2, 0.3], [0.1, 0.2, -0.3]])
    np.testing.assert_allclose(distance_to_mesh(points, SQUARE, faces).signed, [0.3, -0.3], atol=ROUNDING_M)
    side = -1.0 if reverse else 1.0
    by_winding = distance_to_mesh(points, SQUARE, faces, sign="winding").signed
    np.testing.assert_allclose(by_winding, side * np.array([0.3, -0.3]), atol=ROUNDING_M)


@pytest.mark.parametrize(("n_z", "is_reversed"), [(-0.049, False), (-0.051, True), (0.02, False)])
def test_sign_up_reverses_only_triangles_that_face_down_by_more_than_a_twentieth(n_z, is_reversed):
    normal = np.array([np.sqrt(1.0 - n_z**2), 0.0, n_z])
    down_slope = np.array([-n_z, 0.0, normal[0]])
    across = np.cross(down_slope, normal)
    vertices = np.array([-across - down_slope, across - down_slope, down_slope])
    if np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0]) @ normal < 0:
        vertices = vertices[::-1]
    signed = distance_to_mesh(0.25 * normal[None], vertices, np.array([[0, 1, 2]])).signed
    np.testing.assert_allclose(signed, [-0.25 if is_reversed else 0.25], atol=ROUNDING_M)


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("height", [3.0, -3.0])
def test_on_both_sides_of_a_ridge_and_of_a_valley_the_sign_is_that_of_the_side(height, mixed, rng):
    """Nearest points on the fold itself are those within the cone of both normals; their sign is a tie."""
    vertices = np.array([[-2.0, -9, 0], [0, -9, height], [2, -9, 0], [-2, 9, 0], [0, 9, height], [2, 9, 0]])
    faces = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]])
    faces[: 2 if mixed else 4] = faces[: 2 if mixed else 4, ::-1]
    points = np.stack([rng.uniform(-0.4, 0.4, 800), rng.uniform(-3, 3, 800), rng.uniform(-6, 6, 800)], axis=1)
    surface = height * (1.0 - np.abs(points[:, 0]) / 2.0)
    above = points[:, 2] > surface
    near = np.abs(points[:, 2] - height) < 2.0
    signed = distance_to_mesh(points, vertices, faces).signed
    assert near.sum() > 200
    np.testing.assert_array_equal(signed[near] > 0, above[near])


def test_many_triangles_around_one_vertex_agree_on_its_sign():
    angles = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    rim = np.stack([np.cos(angles), np.sin(angles), np.full(400, -1.0)], axis=1)
    vertices = np.concatenate([[[0.0, 0, 0]], rim])
    faces = np.array([[0, 1 + k, 1 + (k + 1) % 400] for k in range(400)])
    points = np.array([[0.0, 0, 2.0], [0.3, 0.1, 1.0], [0.0, 0.0, -0.5]])
    signed = distance_to_mesh(points, vertices, faces).signed
    # A regular pyramid: the distance of a point on its axis to each side.
    apothem = np.cos(np.pi / 400)
    np.testing.assert_allclose(signed[0], 2.0, atol=ROUNDING_M)
    np.testing.assert_allclose(signed[1], np.sqrt(1.1), atol=ROUNDING_M)
    np.testing.assert_allclose(signed[2], -0.5 * apothem / np.hypot(1.0, apothem), atol=ROUNDING_M)


def test_triangles_without_area_are_left_out_and_counted(rng):
    vertices = np.concatenate([SQUARE, [[0.0, 0.0, 0.0], [0.5, 0.5, 0.0]]])
    flat = np.array([[0, 0, 2], [1, 1, 1], [0, 4, 5]])
    points = rng.uniform(-1, 1, (200, 3))
    result = distance_to_mesh(points, vertices, np.concatenate([flat, SQUARE_FACES]))
    assert result.num_degenerate == 3
    np.testing.assert_allclose(result.signed, points[:, 2], atol=ROUNDING_M)


def test_a_mesh_of_lines_and_an_unknown_sign_are_refused():
    with pytest.raises(ValueError, match="none of the 1 triangles has an area"):
        distance_to_mesh(np.zeros((1, 3)), SQUARE, np.array([[0, 0, 1]]))
    with pytest.raises(ValueError, match='expected "up" or "winding"'):
        distance_to_mesh(np.zeros((1, 3)), SQUARE, SQUARE_FACES, sign="down")


def test_points_that_are_not_finite_stay_nan_and_do_not_disturb_the_others():
    points = np.array([[0.0, 0, 1], [np.nan, 0, 1], [0, np.inf, 1], [0, 0, 2]])
    signed = distance_to_mesh(points, SQUARE, SQUARE_FACES).signed
    np.testing.assert_array_equal(np.isnan(signed), [False, True, True, False])
    np.testing.assert_allclose(signed[[0, 3]], [1.0, 2.0], atol=ROUNDING_M)
    for count in (0, 1, 2):
        signed = distance_to_mesh(np.full((count, 3), 0.5), SQUARE, SQUARE_FACES).signed
        np.testing.assert_allclose(signed, np.full(count, 0.5), atol=ROUNDING_M)


def test_progress_adds_up_to_the_number_of_points(rng):
    done = []
    distance_to_mesh(rng.normal(size=(120_000, 3)), SQUARE, SQUARE_FACES, advance=done.append)
    assert sum(done) == 120_000
    assert len(done) > 1


def test_welding_joins_equal_vertices_and_nothing_else(rng):
    vertices, faces = _box(np.array([1.0, 0.7, 0.2]))
    shuffled = rng.permutation(len(faces))
    soup, soup_faces = _soup(vertices, faces[shuffled])
    welded, welded_faces = weld(soup, soup_faces)
    assert len(welded) == 8
    np.testing.assert_array_equal(welded[welded_faces], soup[soup_faces])
    nearly = np.array([[0.0, 0, 0], [np.nextafter(0.0, 1.0), 0, 0], [-0.0, 0, 0]])
    assert weld(nearly, np.array([[0, 1, 2]]))[1].tolist() == [[0, 1, 0]]


@pytest.mark.parametrize("size", [2, 5, 9])
def test_exactly_surfaces_with_turned_triangles_have_edges_that_run_one_way_twice(size):
    number = np.arange(size * size).reshape(size, size)
    nw, ne, sw, se = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack(abc, axis=-1).reshape(-1, 3) for abc in ((nw, sw, ne), (ne, sw, se))])
    assert num_inconsistent_edges(faces) == num_inconsistent_edges(faces[:, ::-1]) == 0
    rng = np.random.default_rng(size)
    for share in (0.1, 0.5, 0.9):
        turned = rng.random(len(faces)) < share
        turned[0], turned[-1] = True, False
        mixed = np.where(turned[:, None], faces[:, ::-1], faces)
        assert num_inconsistent_edges(mixed) > 0
    assert num_inconsistent_edges(np.concatenate([faces, faces[:, ::-1]])) > 0
