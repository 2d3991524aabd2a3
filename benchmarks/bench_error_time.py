"""How do the published fields get on with time, dry and under water?

    python benchmarks/bench_error_time.py WORK [--models mdw tensorf ...] [--seconds S] [--seeds N] [--draw]

Every model trains on the scene of `bench_switches`, dry and under 2 m of water, for as many steps as take S seconds of
processor time here, measured on some steps before. After 1, 2, 4, ... s and at the end pixels of the photographs that
were held out are rendered: PSNR, and median error of the distance to the surface; of several seeds the mean with its
95 % interval. Trainings are kept in WORK for the same settings and code; prints Markdown; --draw writes
docs/img/field_error_time.png, of the first seed.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from itertools import product
from pathlib import Path

import error_time
from error_time import SCENES, measure
from field_tables import DOCS, LABELS, interval
from gallery_canvas import BLUE, DARK_ORANGE, GREEN, RED, canvas, label, save
from kept_results import kept_result
from matplotlib.ticker import NullFormatter, StrMethodFormatter

from fields.volume.models import MODELS


def table(rows: list[dict]) -> list[str]:
    """Markdown: each model at the end of its training, dry and wet."""
    lines = ["| model | steps, dry | PSNR | depth error | steps, wet | PSNR | depth error |", "|---" * 7 + "|"]
    for name in dict.fromkeys(row["model"] for row in rows):
        cells = []
        for where in SCENES:
            of = [row for row in rows if (row["model"], row["scene"]) == (name, where)]
            last = [row["looks"][-1] for row in of]
            cells += ["-"] * 3 if not of else [
                interval([row["steps"] for row in of], 0),
                f"{interval([look['psnr_db'] for look in last], 1)} dB",
                f"{interval([1e3 * look['depth_m'] for look in last], 0)} mm",
            ]  # fmt: skip
        lines.append(f"| {LABELS[name]} | {' | '.join(cells)} |")
    return lines


def draw(rows: list[dict], path: Path) -> None:
    """Errors of distance and PSNR over time, dry and wet."""
    figure, plots = canvas(10.0, 7.2, nrows=2, ncols=2, sharex=True, sharey="row")
    colours, styles = (BLUE, RED, GREEN, DARK_ORANGE, "#5d6a76"), ("-", "--", ":")
    for column, where in enumerate(SCENES):
        for number, name in enumerate(dict.fromkeys(row["model"] for row in rows)):
            of = [r["looks"] for r in rows if (r["model"], r["scene"]) == (name, where)]
            style = {"color": colours[number % 5], "ls": styles[number // 5], "marker": "o", "ms": 2.5, "lw": 1.2}
            for looks in of:
                seconds = [look["seconds"] for look in looks]
                plots[0, column].plot(seconds, [1e3 * look["depth_m"] for look in looks], label=LABELS[name], **style)
                plots[1, column].plot(seconds, [look["psnr_db"] for look in looks], **style)
        label(plots[0, column], f"{where}: distance", "", "" if column else "median error [mm]")
        label(plots[1, column], f"{where}: photographs held out", "processor time [s]", "" if column else "PSNR [dB]")
    plots[1, 0].set_xscale("log", base=2)
    plots[0, 0].set_yscale("log")
    for axis in (plots[1, 0].xaxis, plots[0, 0].yaxis):
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    plots[0, 0].set_yticks((10, 20, 50, 100, 200, 500))
    figure.legend(*plots[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=8.5, frameon=False)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--draw", action="store_true")
    options = parser.parse_args()
    options.work.mkdir(parents=True, exist_ok=True)
    rows = []
    for seed, where, name in product(range(options.seeds), SCENES, options.models):
        of = (name, where, options.seconds, seed)
        settings = dict(zip(("model", "scene", "seconds", "seed"), of, strict=True))
        compute = partial(measure, *of)
        rows.append(kept_result(options.work, f"{name}_{where}_{seed}", settings, error_time.__file__, compute))
        sys.stderr.write(f"{name} {where} {seed} {rows[-1]['looks'][-1]}\n")
    sys.stdout.write("\n".join(table(rows)) + "\n")
    if options.draw:
        draw([row for row in rows if row["seed"] == 0], DOCS / "img" / "field_error_time.png")


if __name__ == "__main__":
    main()
