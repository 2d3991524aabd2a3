"""Products that normal equations are made of."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_array

from survey.adjust.block.normal_equations import eliminated
from survey.adjust.block.state import NUM_POSE


@pytest.mark.parametrize(
    ("num_points", "num_views", "num_others"),
    [(40, 6, 15), (40, 300, 15), (40, 300, 15 + 300)],
    ids=["few photographs", "many photographs", "a focal length for each photograph"],
)
def test_the_eliminated_part_is_the_product_of_the_coupling_with_itself(rng, num_points, num_views, num_others):
    coupling = np.zeros((3 * num_points, num_others + NUM_POSE * num_views))
    for point in range(num_points):
        rows = slice(3 * point, 3 * point + 3)
        coupling[rows, :15] = rng.normal(size=(3, 15))
        for view in rng.choice(num_views, 4, replace=False):
            first = num_others + NUM_POSE * view
            coupling[rows, first : first + NUM_POSE] = rng.normal(size=(3, NUM_POSE))
            if num_others > 15:
                coupling[rows, 15 + view] = rng.normal(size=3)
    found = eliminated(csr_array(coupling), num_others)
    # Sums of some hundred products of about one, in another order.
    np.testing.assert_allclose(found.toarray(), coupling.T @ coupling, rtol=0.0, atol=1e-12)
