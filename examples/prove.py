"""Depths of a finished run against rods: a table, the ratio of depths, and whether the stated std holds.

    python examples/prove.py RUN

RUN is the run folder of a survey with [control] checkpoints (docs/prove-it.md). Straight rays would show about three
quarters of each depth.
"""

import json
import math
import sys
from pathlib import Path

# Of a normal distribution, 95 % lie within so many standard deviations.
TO_95 = 1.959964
# Least depth of a rod that counts for the ratio [m].
LEAST_DEPTH_M = 0.1


def table(rows: list[dict]) -> list[str]:
    """Lines for the check points of a report, and what they say together."""
    lines = [f"{'rod':16} {'depth':>8} {'found':>8} {'error':>8} {'std':>8}  within 1.96 std"]
    told = [row for row in rows if row["difference_m"] is not None]
    for row in rows:
        if row["difference_m"] is None:
            lines.append(f"{row['name']:16} {_metres(row['depth_m'])} no point of the cloud around it")
            continue
        off, std = row["difference_m"], row["stated_m"]
        found = None if row["depth_m"] is None else row["depth_m"] - off
        within = "" if std is None else "yes" if abs(off) <= TO_95 * std else "NO"
        lines.append(
            f"{row['name']:16} {_metres(row['depth_m'])} {_metres(found)} {off:+8.3f} {_metres(std)}  {within}"
        )
    if not told:
        return [*lines, "", "no rod lies under the cloud"]
    off = [row["difference_m"] for row in told]
    mean, rms = sum(off) / len(off), math.sqrt(sum(each * each for each in off) / len(off))
    lines += ["", f"{len(told)} of {len(rows)} rods: mean {mean:+.3f} m, rms {rms:.3f} m"]
    judged = [row for row in told if row["stated_m"] is not None]
    if judged:
        inside = sum(abs(row["difference_m"]) <= TO_95 * row["stated_m"] for row in judged)
        lines.append(f"{inside} of {len(judged)} within 1.96 of the stated standard deviation (expected: 95 %)")
    wet = [row for row in told if (row["depth_m"] or 0.0) > LEAST_DEPTH_M]
    if wet:
        square = sum(row["depth_m"] ** 2 for row in wet)
        ratio = sum(row["depth_m"] * (row["depth_m"] - row["difference_m"]) for row in wet) / square
        left = [row["depth_m"] * (1.0 - ratio) - row["difference_m"] for row in wet]
        std = math.sqrt(sum(each * each for each in left) / max(len(wet) - 1, 1) / square)
        lines.append(
            f"depth found over depth measured: {ratio:.3f} +- {std:.3f} (1 is right; straight rays: about 0.75)"
        )
    return lines


def _metres(value: float | None) -> str:
    return " " * 8 if value is None else f"{value:8.3f}"


def main(arguments: list[str] | None = None) -> None:
    """Print the table of a run."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) != 1:
        raise SystemExit("usage: python examples/prove.py RUN")
    path = Path(given[0]) / "report.json"
    if not path.is_file():
        raise SystemExit(f"{path} does not exist; expected the run folder of a finished `bathynerf process`")
    found = json.loads(path.read_text(encoding="utf-8")).get("checkpoints")
    if found is None:
        raise SystemExit(f"{path} has no check points; give [control] checkpoints in survey.toml (docs/prove-it.md)")
    sys.stdout.write("\n".join(table(found["rows"])) + "\n")


if __name__ == "__main__":
    main()
