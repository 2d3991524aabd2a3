"""The block as a least-squares problem: observations, unknowns, priors, and their solution."""
