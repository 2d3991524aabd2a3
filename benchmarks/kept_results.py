"""Results of benchmarks of small fields, each computed once for its settings and its code."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import switch_scene

from survey.stage_key import code_hash

CODE = ("fields.volume.models", "fields.volume.train", "evaluation.images.quality")


def kept_result(work: Path, name: str, settings: dict, benchmark: str, compute: Callable[[], Any]) -> Any:
    """A result, computed unless ``work`` has one of the same settings, scene and code.

    Parameters
    ----------
    name : str
        Begins the name of the file.
    settings : dict
        All that the result depends on beside code, as values for JSON.
    benchmark : str
        File of the benchmark's own code.
    compute : callable
        Makes the result, of values for JSON.
    """
    digest = hashlib.sha256(json.dumps([settings, code_hash(*CODE)]).encode())
    for file in (benchmark, switch_scene.__file__):
        digest.update(Path(file).read_bytes())
    path = work / f"{name}_{digest.hexdigest()[:12]}.json"
    if not path.is_file():
        path.write_text(json.dumps(compute(), indent=2))
    return json.loads(path.read_text())
