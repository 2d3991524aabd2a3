"""List the licence of everything that bathynerf needs, with its installed extras; fail at one that does not fit.

python scripts/licences.py

What fits may be used and distributed together with work under Apache-2.0. MPL-2.0 does: it covers its own files alone.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from importlib.metadata import Distribution, PackageNotFoundError, distribution

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

FITS = re.compile(
    r"Apache([ -]2\.0| Software)|\bMIT\b|\bMIT-CMU\b|\b0?BSD\b|\bISC\b|\bPSF|Python Software Foundation|\bMPL|Mozilla"
    r"|\bZlib\b|\bCC0|\bBSL-1\.0\b|\bUnlicense\b|Public Domain|\bHPND\b"
)
# A word of any of these decides, whatever stands beside it, unless it is one of a choice.
FITS_NOT = re.compile(r"\bA?GPL|\bLGPL|GNU (Affero|General|Lesser)|[Nn]on-?[Cc]ommercial|\bNC\b|Proprietary|CC-BY-NC")
# What the CUDA build of torch brings is NVIDIA's and comes from NVIDIA; the CPU build does without.
OF_CUDA = re.compile(r"^(nvidia|cuda)-")
# Read by hand. docutils (extra "docs"): only its Emacs mode is under the GPL, which its wheel does not contain.
REVIEWED = {"docutils": "Public Domain; BSD License; GNU General Public License (GPL)"}


def licence_of(found: Distribution) -> str:
    """The SPDX expression of a distribution, else what its classifiers say, else the first line of its licence."""
    expression = found.metadata.get("License-Expression")
    if expression:
        return expression
    classifiers = found.metadata.get_all("Classifier") or []
    named = [line.split(" :: ")[-1] for line in classifiers if line.startswith("License ::")]
    return "; ".join(named) or (found.metadata.get("License") or "unknown").strip().splitlines()[0]


def fits(name: str, licence: str) -> bool:
    """Whether a package may be used and distributed with work under Apache-2.0."""
    if OF_CUDA.match(name) or REVIEWED.get(name) == licence:
        return True
    choices = licence.split(" OR ")
    return any(FITS.search(choice) and not FITS_NOT.search(choice) for choice in choices)


def needed(root: str, extras: tuple[str, ...]) -> dict[str, Distribution]:
    """Installed distributions that one needs with these extras, itself left out, by name."""
    found: dict[str, Distribution] = {}
    waiting = [(root, extras)]
    seen = set()
    while waiting:
        name, with_extras = waiting.pop()
        for requirement in _requirements(name, with_extras):
            key = (canonicalize_name(requirement.name), tuple(sorted(requirement.extras)))
            if key in seen:
                continue
            seen.add(key)
            try:
                found[key[0]] = distribution(key[0])
            except PackageNotFoundError:
                continue
            waiting.append(key)
    found.pop(root, None)
    return dict(sorted(found.items()))


def _requirements(name: str, extras: tuple[str, ...]) -> Iterator[Requirement]:
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        if requirement.marker is None or any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            yield requirement


def main() -> int:
    """Print the list; 1 where something does not fit."""
    extras = tuple(distribution("bathynerf").metadata.get_all("Provides-Extra") or ())
    wrong = 0
    for name, found in needed("bathynerf", extras).items():
        licence = licence_of(found)
        is_fit = fits(name, licence)
        wrong += not is_fit
        sys.stdout.write(f"{name:28} {found.version:12} {licence}{'' if is_fit else '   DOES NOT FIT Apache-2.0'}\n")
    return min(wrong, 1)


if __name__ == "__main__":
    sys.exit(main())
