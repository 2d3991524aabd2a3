"""Photographs that look alike, for those whose place is not known: votes of their largest features.

No vocabulary is trained or fetched: each large feature votes for the photographs with the most similar ones. That
compares all photographs with each other, by a hundredth of what it takes to match them: the pairs that are then matched
grow with the number of photographs, the votes with its square (`VOTING` features each).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from survey.sfm.settings import NEIGHBOURS

# Features of a photograph that vote, those of the largest scale: they are found again in most photographs of a place.
VOTING = 100
# Photographs that are compared with one at a time.
_AT_ONCE = 500


def alike(descriptors: Iterable[np.ndarray], num: int, of: Sequence[int]) -> Iterator[tuple[int, int]]:
    """Photographs that some of them look like most, the best first: pairs of numbers.

    Parameters
    ----------
    descriptors : iterable of (F, 128) uint8
        Of all photographs, those of the largest scale first; read one by one.
    num : int
        Of photographs.
    of : sequence of int
        The photographs whose partners are sought.
    """
    every = np.zeros((num, VOTING, 128), np.float32)
    for number, own in enumerate(descriptors):
        own = own[:VOTING].astype(np.float32)
        every[number, : len(own)] = own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1.0)
    for number in of:
        votes = _votes(every, number)
        votes[number] = 0.0
        best = np.argsort(-votes, kind="stable")[:NEIGHBOURS]
        for other in best[votes[best] > 0.0]:
            yield number, int(other)


def _votes(every: np.ndarray, number: int) -> np.ndarray:
    """Votes (V,) of a photograph's features for all, by how much more similar these are than those of most."""
    ours, parts = every[number].T, np.array_split(every, -(-len(every) // _AT_ONCE))
    likeness = np.concatenate([(part.reshape(-1, 128) @ ours).reshape(len(part), VOTING, -1).max(1) for part in parts])
    likeness[number] = 0.0
    count = min(NEIGHBOURS + 1, len(every) - 1)
    usual = np.partition(likeness, -count, axis=0)[-count]
    return np.maximum(likeness - usual, 0.0).sum(axis=1)
