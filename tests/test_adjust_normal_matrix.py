"""The normal equations of an adjustment and their factors, against dense ones."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array

from survey.adjust.block.normal_equations import huber_system
from survey.adjust.block.normal_matrix import _ROWS, BlockFactor, DenseFactor, NormalMatrix, elimination_order
from survey.adjust.block.prediction import design_matrix, linearise
from survey.adjust.block.priors import PriorKnowledge, prior_of, priors_for
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import NUM_RELIEF
from survey.photos.poses import TiePoints
from tests.block_survey import survey_of
from tests.drawn_block import draw_block

NUM_SHARED, NUM_VIEWS, OF_VIEW, PER_VIEW = 5, 60, 6, 4


def normal_of(rng, size: int) -> NormalMatrix:
    design = rng.normal(size=(size + 20, size)) * 10.0 ** rng.uniform(-3.0, 3.0, size)
    return NormalMatrix.of(csr_array(design.T @ design))


def scaled(normal: NormalMatrix) -> tuple[np.ndarray, np.ndarray]:
    scale = 1.0 / np.sqrt(normal.diagonal())
    return normal.dense() * np.outer(scale, scale), scale


@pytest.fixture(scope="module")
def two_strips() -> NormalMatrix:
    """Two strips of photographs in any order; each has points in common with the three before it in its strip."""
    rng = np.random.default_rng(5)
    number, strip = rng.permutation(NUM_VIEWS), np.arange(NUM_VIEWS) // (NUM_VIEWS // 2)
    first = np.repeat(np.arange(NUM_VIEWS), PER_VIEW)
    along = np.add.outer(first, np.arange(4))
    inside = (along < NUM_VIEWS) & (strip[np.minimum(along, NUM_VIEWS - 1)] == strip[first][:, None])
    point, of_point = np.nonzero(inside)
    view = number[along[point, of_point]]
    photograph = np.concatenate([np.full(NUM_SHARED, -1), np.repeat(np.arange(NUM_VIEWS), OF_VIEW)])
    of_view = NUM_SHARED + OF_VIEW * view[:, None] + np.arange(OF_VIEW)
    columns = np.concatenate([np.tile(np.arange(NUM_SHARED), (len(view), 1)), of_view], axis=1)
    size = len(photograph)
    # Points eliminated: what is left couples the photographs of each.
    design = csr_array((rng.normal(size=columns.size), columns.ravel(), columns.shape[1] * np.arange(len(view) + 1)))
    means = csr_array((np.ones(len(point)), (point, np.arange(len(point)))))
    means = csr_array(means.multiply(means.sum(axis=1)[:, None] ** -0.5))
    units = csr_array((10.0 ** rng.uniform(-3.0, 3.0, size), np.arange(size), np.arange(size + 1)))
    left = means @ design
    normal = design.T @ design - 0.9 * (left.T @ left)
    normal = units @ (normal + 0.01 * diags_array(normal.diagonal())) @ units
    return NormalMatrix.of(normal, elimination_order(point, view, photograph, small=0))


def with_joint_priors(normal: NormalMatrix, seed: int) -> NormalMatrix:
    """With a prior that holds something of all photographs, and one that takes out half of what another one has."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2, len(normal))) * np.sqrt(normal.diagonal())
    least = np.linalg.eigvalsh(scaled(normal)[0])[0]
    rows *= np.sqrt(0.5 * least / np.sum(rows**2 / normal.diagonal(), axis=1))[:, None]
    return normal.with_rows(rows, np.array([1.0, -1.0]))


def test_a_step_solves_the_equations_with_their_scaled_diagonal_raised(rng):
    normal, right = normal_of(rng, 40), rng.normal(size=40)
    raised = normal.dense() + np.diag(0.01 * normal.diagonal())
    step, scale = normal.factor(0.01).solve(right), np.sqrt(normal.diagonal())
    # In units that make the diagonal ones, Cholesky's backward error of an entry is below 3 n + 1 roundings (N. J.
    # Higham, Accuracy and Stability of Numerical Algorithms, theorem 10.4), of n entries and with the product 4 n^2.
    bound = 4.0 * len(right) ** 2 * np.finfo(np.float64).eps * np.abs(scale * step).max()
    assert np.abs((raised @ step - right) / scale).max() < bound


def test_the_inverse_is_one_whatever_the_units(rng):
    normal = normal_of(rng, 300)
    scale = np.sqrt(normal.diagonal())
    product = normal.inverse @ normal.dense()
    np.testing.assert_allclose(product * scale[:, None] / scale, np.eye(300), rtol=0.0, atol=1e-9)


def test_strips_are_eliminated_along_them(two_strips):
    order = two_strips.order
    assert order is not None
    assert max(map(len, order.blocks)) <= 3 * OF_VIEW
    np.testing.assert_array_equal(np.sort(np.concatenate([*order.blocks, order.shared])), np.arange(len(two_strips)))
    matrix = two_strips.dense()
    for number, block in enumerate(order.blocks):
        for other in order.blocks[number + 2 :]:
            assert not matrix[np.ix_(block, other)].any()


@pytest.mark.parametrize("joint", [False, True], ids=["alone", "with joint priors"])
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_a_block_factor_says_what_a_dense_one_does(two_strips, damping, joint):
    normal = with_joint_priors(two_strips, 6) if joint else two_strips
    by_blocks, dense = normal.factor(damping), replace(normal, order=None).factor(damping)
    assert isinstance(by_blocks, BlockFactor)
    assert isinstance(dense, DenseFactor)
    matrix, scale = scaled(normal)
    eigenvalues = np.linalg.eigvalsh(matrix) + damping
    # Errors of both are some roundings times the condition number.
    bound = 1e3 * np.finfo(np.float64).eps * eigenvalues[-1] / eigenvalues[0]
    right = np.random.default_rng(7).normal(size=(len(normal), 3)) / scale[:, None]
    for each in (right, right[:, 0]):
        units = scale.reshape(-1, *(1,) * (each.ndim - 1))
        off = (by_blocks.solve(each) - dense.solve(each)) / units
        assert np.abs(off).max() < bound * np.abs(dense.solve(each) / units).max()
    whole = dense.inverse() / np.outer(scale, scale)
    assert np.abs(by_blocks.inverse() / np.outer(scale, scale) - whole).max() < bound * np.abs(whole).max()
    assert np.abs(by_blocks.inverse_diagonal() / scale**2 - np.diag(whole)).max() < bound * np.abs(whole).max()


@pytest.mark.parametrize("joint", [False, True], ids=["alone", "with joint priors"])
def test_parts_and_determinants_are_those_of_the_dense_matrix(two_strips, joint):
    normal = with_joint_priors(two_strips, 6) if joint else two_strips
    matrix, rng = normal.dense(), np.random.default_rng(8)
    some = np.sort(rng.permutation(len(normal))[: len(normal) // 2])
    others = np.setdiff1d(np.arange(len(normal)), some)
    roundings = 1e-12 * np.sqrt(np.outer(normal.diagonal(), normal.diagonal()))
    assert (
        np.abs(normal.between(some, others) - matrix[np.ix_(some, others)]) <= roundings[np.ix_(some, others)]
    ).all()
    part = normal.only(some)
    np.testing.assert_allclose(part.dense(), matrix[np.ix_(some, some)], rtol=0.0, atol=roundings.max())
    for each in (normal, part):
        assert isinstance(each.factor(), BlockFactor)
        assert each.factor().log_determinant() == pytest.approx(np.linalg.slogdet(each.dense())[1], abs=1e-6)
        assert replace(each, order=None).factor().log_determinant() == pytest.approx(
            np.linalg.slogdet(each.dense())[1], abs=1e-6
        )


@pytest.mark.parametrize("views", [range(2), range(260)], ids=["a small block", "photographs that all overlap"])
def test_blocks_that_gain_nothing_are_dense(views):
    photograph = np.repeat(np.arange(len(views)), OF_VIEW)
    assert elimination_order(np.zeros(len(views), dtype=np.int64), np.array(views), photograph) is None


@pytest.mark.parametrize(
    ("take", "arrays"), [(lambda n: n.factor(1e-3).solve(np.ones(len(n))), 1.0), (lambda n: n.inverse, 2.0)]
)
def test_a_large_matrix_is_copied_as_rarely_as_can_be(rng, take, arrays):
    normal = normal_of(rng, 1200)
    tracemalloc.start()
    take(normal)
    peak = tracemalloc.get_traced_memory()[1] / (8 * len(normal) ** 2)
    tracemalloc.stop()
    # And the rows that are copied at a time, sparse ones with their columns; fifty vectors beside them are no copy.
    assert peak < arrays + 2.5 * _ROWS / len(normal) + 50 / len(normal)


@pytest.mark.parametrize("by_blocks", [False, True])
def test_a_singular_matrix_is_refused(two_strips, by_blocks):
    normal = two_strips if by_blocks else NormalMatrix.of(csr_array(np.eye(2)))
    with pytest.raises(np.linalg.LinAlgError):
        _ = normal.with_precision(-2.0 * normal.diagonal()).inverse


PIXEL_STD = 0.3


def prior_with(num_lenses: int, *, finds_focals: bool) -> tuple[PriorKnowledge, TiePoints]:
    """A block of 12 photographs through several lenses, each with a focal length of its own if asked for."""
    survey = survey_of(draw_block(3, num_points=80, num_views=12, nadir_only=False, num_control=0))
    prior, ties = prior_of(survey, 0.02), survey.observations.ties
    num = len(prior.layout.lens_of)
    layout = replace(
        prior.layout, lens_of=np.arange(num) % num_lenses, aspect=np.ones(num_lenses), finds_focals=finds_focals
    )
    lenses, focals = np.tile(prior.state.lenses, (num_lenses, 1)), np.zeros(num if finds_focals else 0)
    state = replace(prior.state, lenses=lenses, focals=focals)
    of_lens = prior.std[prior.layout.first_lens : prior.layout.first_pose]
    std = np.concatenate(
        [
            prior.std[: prior.layout.first_lens],
            np.tile(of_lens, num_lenses),
            np.full(len(focals), 0.01),
            prior.std[prior.layout.first_pose :],
        ]
    )
    return replace(prior, layout=layout, state=state, mean=state, std=std, lenses=prior.lenses * num_lenses), ties


@pytest.mark.parametrize(
    ("num_lenses", "finds_focals"),
    [(1, False), (2, False), (12, False), (1, True)],
    ids=["one lens", "two lenses", "a lens for each photograph", "a focal length for each photograph"],
)
def test_normal_equations_are_those_of_dense_products(num_lenses, finds_focals):
    prior, ties = prior_with(num_lenses, finds_focals=finds_focals)
    state, rise_design = replace(prior.state, points=ties.start), np.zeros((len(ties.view), NUM_RELIEF))
    std_px = np.array([PIXEL_STD])
    problem = Problem(prior.layout, ties, np.zeros(len(ties.view), int), priors_for(prior, ties), std_px, rise_design)
    linear = linearise(prior.layout, state, ties, rise_design)
    # Without outliers all observations have the same weight.
    ties = replace(ties, pixel=linear.pixels + 0.1)
    problem = replace(problem, ties=ties)
    system = huber_system(problem, state, std_px)
    design = design_matrix(prior.layout, ties.view, linear.by_parameters).toarray() / PIXEL_STD
    by_points = np.zeros((len(ties.view), 2, len(ties), 3))
    by_points[np.arange(len(ties.view)), :, ties.point] = linear.by_point / PIXEL_STD
    by_points = by_points.reshape(len(design), -1)
    mixed = by_points.T @ design
    expected = design.T @ design - mixed.T @ np.linalg.solve(by_points.T @ by_points, mixed)
    scale = 1.0 / np.sqrt(np.diag(design.T @ design) + prior.std**-2.0)
    expected = expected + np.diag(prior.std**-2.0)
    np.testing.assert_allclose(
        system.normal.dense() * np.outer(scale, scale), expected * np.outer(scale, scale), atol=1e-9
    )
    # A step of parameters that points follow, and one row of their coupling.
    step = scale * np.random.default_rng(1).normal(size=len(scale))
    left = np.full(len(design), 0.1 / PIXEL_STD) - design @ step
    points = np.linalg.lstsq(by_points, left)[0].reshape(-1, 3)
    np.testing.assert_allclose(system.point_steps(step), points, atol=1e-6 * np.abs(points).max())
    np.testing.assert_allclose(
        system.coupling.of_point(5) @ step, system.coupling.times(step)[15:18], rtol=1e-9, atol=1e-9
    )
