"""Does any block as it comes from the field end in a traceback, and how good is the result where there is one?

    python benchmarks/bench_real_like.py -o FOLDER [--seed 1] [--count 200] [--by ties|photographs] [--publish]

Each seed is a block of real_like_blocks.py. By photographs it is drawn, processed by the command line (draft) and its
cloud held against the true bed: half a minute of one core, a minute or two for sixty photographs. By ties, the survey
is read and adjusted with exact matches and noise in place of structure from motion and of windows: some seconds; its
tie points are held against the bed, and `std covers` is that of the coordinates of its cameras. Without --by,
blocks of up to eight photographs and every tenth go by photographs, all others by ties. An outcome is a result, a cloud
that failed the quality gate, a clear error, or a crash. Prints rows of seed, block, by, outcome, points, median
error, rms, what std covers, and time; FOLDER/real_like.json has them, and what it has is not run again. --publish
writes how often each outcome was into docs/notes/stress.md. The exit code is 1 where something
crashed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

import laspy
import numpy as np
from published import publish
from real_like_blocks import Flight, RealLikeBlock, bed_of, draw_flights
from real_like_ties import adjusted_by_ties

from geo.errors import GeoError
from geo.las_header import extra_of
from survey.benchmark.benchmark import run_bathynerf
from survey.errors import SurveyError

PAGE = Path(__file__).resolve().parent.parent / "docs" / "notes" / "stress.md"
RESULT, GATE_FAILED, REFUSED, CRASHED = "result", "gate failed", "refused", "CRASHED"
_OUTCOMES = {0: RESULT, 3: GATE_FAILED, 2: REFUSED}
TIES, PHOTOGRAPHS = "ties", "photographs"
# By photographs go the small ones and one of so many.
_SMALL, _EVERY = 8, 10
# Heights beyond this [m] are counted apart, as they would be the whole of the rms.
_FAR_M = 1.0


def by_of(block: RealLikeBlock) -> str:
    """How a block goes where nobody says it."""
    return PHOTOGRAPHS if block.num_views <= _SMALL or block.seed % _EVERY == 0 else TIES


def by_photographs(block: RealLikeBlock, folder: Path, *, keep: bool) -> dict:
    """What came of a block that the command line has processed: a record for JSON."""
    survey, home = folder / f"block_{block.seed}", folder / "home"
    home.mkdir(parents=True, exist_ok=True)
    block.draw(survey, folder / "flights")
    run = survey / "run"
    code, cost, words = run_bathynerf(["process", str(survey), "-o", str(run), "--quality", "draft"], home)
    outcome = _OUTCOMES.get(code, CRASHED)
    record = {"outcome": outcome, "seconds": round(cost.processor_s, 1)}
    if (run / "cloud.las").is_file():
        las = laspy.read(run / "cloud.las")
        extra = extra_of(las)
        std = np.hypot(extra["std"], np.nan_to_num(extra["std_common"]))
        record |= errors_of(np.stack([las.x, las.y, las.z], axis=-1), block, folder / "flights", std)
    elif outcome == CRASHED:
        record["words"] = (home / "stderr.txt").read_text(encoding="utf-8", errors="replace")[-4000:]
    else:
        record["words"] = words.removeprefix("error: ").replace(f"{survey}/", "")
    if outcome != CRASHED and not keep:
        shutil.rmtree(survey)
    return record


def by_ties(block: RealLikeBlock, folder: Path, *, keep: bool) -> dict:
    """What came of a block that was adjusted with exact matches: a record for JSON."""
    survey, start = folder / f"block_{block.seed}", time.process_time()
    block.draw(survey, folder / "flights", grey=True)
    record: dict = {}
    try:
        points, covered = adjusted_by_ties(block, survey, bed_of(folder / "flights" / block.ground))
        record = {"outcome": RESULT} | errors_of(points, block, folder / "flights") | {"covered": covered}
    except (SurveyError, GeoError) as error:
        record = {"outcome": REFUSED, "words": str(error).replace(f"{survey}/", "")}
    except Exception:
        record = {"outcome": CRASHED, "words": traceback.format_exc()[-4000:]}
    if record["outcome"] != CRASHED and not keep:
        shutil.rmtree(survey)
    return record | {"seconds": round(time.process_time() - start, 1)}


def errors_of(points: np.ndarray, block: RealLikeBlock, flights: Path, std: np.ndarray | None = None) -> dict:
    """Vertical errors of points (N, 3) in crs [m], and the share that their standard deviations (N,) cover."""
    if not len(points):
        return {"words": "no points"}
    local = Flight.of(block.ground).frame.local_from_crs(points)
    error = local[:, 2] - bed_of(flights / block.ground).height(local[:, 0], local[:, 1])
    near = np.abs(error) < _FAR_M
    return {
        "points": len(points),
        "median_m": float(np.median(error)),
        "rms_m": float(np.sqrt(np.mean(error[near] ** 2))) if near.any() else None,
        "far": float(np.mean(~near)),
        "covered": None if std is None else float(np.mean(np.abs(error) <= 1.96 * std)),
    }


def row_of(seed: int, record: dict) -> str:
    """One line of the table."""
    start = f"| {seed} | {RealLikeBlock.of(seed)} | {record['by']} | {record['outcome']}"
    end = f"{record['seconds']:.0f} s |"
    if "points" not in record:
        words = (record["words"].strip().splitlines() or [""])[-1]
        return f"{start}: {words[:200].replace('|', '/')} | | | | | {end}"
    covered = "" if record["covered"] is None else f"{100.0 * record['covered']:.0f} %"
    far = f", {100.0 * record['far']:.1f} % beyond {_FAR_M:g} m" if record["far"] > 0.0005 else ""
    rms = "" if record["rms_m"] is None else f"{1e3 * record['rms_m']:.0f} mm"
    return f"{start} | {record['points']:,} | {1e3 * record['median_m']:.0f} mm | {rms}{far} | {covered} | {end}"


def totals_of(found: dict[str, dict]) -> list[str]:
    """A table of how often each outcome was."""
    counts = Counter((record["by"], record["outcome"]) for record in found.values())
    outcomes = (RESULT, GATE_FAILED, REFUSED, CRASHED)
    lines = [f"| by | blocks | {' | '.join(outcomes)} |", f"|{(2 + len(outcomes)) * '---|'}"]
    for by in (PHOTOGRAPHS, TIES):
        num = sum(record["by"] == by for record in found.values())
        if num:
            lines.append(f"| {by} | {num} | {' | '.join(str(counts[by, name]) for name in outcomes)} |")
    return lines


def main() -> None:
    """Run the seeds that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=1, help="the first")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--by", choices=(TIES, PHOTOGRAPHS))
    parser.add_argument("--keep", action="store_true", help="the folders of all blocks, not of those that crash alone")
    parser.add_argument("--publish", action="store_true", help="into docs")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    draw_flights(options.output / "flights")
    path = options.output / "real_like.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    asked = {}
    for seed in range(options.seed, options.seed + options.count):
        block = RealLikeBlock.of(seed)
        by = options.by or by_of(block)
        if f"{seed} {by}" not in found:
            run = by_ties if by == TIES else by_photographs
            found[f"{seed} {by}"] = run(block, options.output, keep=options.keep) | {"by": by}
            path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        asked[str(seed)] = found[f"{seed} {by}"]
        print(row_of(seed, asked[str(seed)]), flush=True)  # noqa: T201
    print("\n".join(totals_of(asked)))  # noqa: T201
    if options.publish:
        publish(PAGE, "real-like", totals_of(asked))
    sys.exit(1 if any(record["outcome"] == CRASHED for record in asked.values()) else 0)


if __name__ == "__main__":
    main()
