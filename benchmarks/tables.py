"""Tables of the documentation, written anew from the results that lie in benchmarks/results: nothing is measured.

    python benchmarks/tables.py

Commands that measure write the results with --publish; those of real photographs and of drawn conditions write their
tables, too.
"""

import json
from pathlib import Path
from textwrap import fill

import numpy as np
from method_records import METHODS, Record, read_results

ROOT = Path(__file__).resolve().parent.parent
RESULTS, DOCS = ROOT / "benchmarks" / "results", ROOT / "docs"
# Method and quality of the rows of data/quick.
QUICK = (
    ("full", "draft"), ("full", "standard"), ("straight", "standard"),
    ("times_index", "standard"), ("per_camera", "standard"),
)  # fmt: skip
# Of surveys with straight rays: name in the results, words, mean depth [m].
STRAIGHT = (
    ("drawn_0.5_nadir_20", "0.5 m, nadir", 0.5),
    ("drawn_2_oblique_20", "2 m, oblique", 2.0),
    ("quick", "data/quick, 2.9 m, oblique", 2.9),
    ("drawn_3.5_nadir_20", "3.5 m, nadir", 3.5),
    ("drawn_8_oblique_20", "8 m, oblique", 8.0),
)
TO_95 = 1.959964
# Further off than this a target is wrong, not uncertain [m].
WRONG_M = 1.0
AXES = ("east", "north", "up")
# Of lines of the documentation.
WIDTH = 118


def profile_rows(found: dict) -> list[str]:
    """The lake's depths against the lidar's."""
    lines = [
        "| rays | points beside the profile | depth over the lidar's | bias | scatter | median std | within 1.96 std "
        "| over the water |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in ("bent", "straight"):
        each = found[name]
        lines.append(
            f"| {name} | {each['points']:,} | {each['ratio']:.2f} | {each['bias_m']:+.2f} m | "
            f"{each['scatter_m']:.2f} m | {each['std_m']:.2f} m | {100 * each['within']:.0f} % | {each['over_water']} |"
        )
    return lines


def target_rows(found: dict) -> list[str]:
    """Targets left out in turn, and how many lie within what is stated."""
    lines = [
        "| target left out | marks | east | north | up | std of up | within 1.96 std |",
        "|---|---|---|---|---|---|---|",
    ]
    inside, sound = 0, 0
    for name, each in found["targets"].items():
        off, std = np.array(each["off_m"]), np.array(each["std_m"])
        within = np.abs(off) <= TO_95 * std
        is_wrong = bool(np.abs(off).max() > WRONG_M)
        inside, sound = inside + (0 if is_wrong else int(within[2])), sound + (not is_wrong)
        beyond = [axis for axis, is_in in zip(AXES, within, strict=True) if not is_in]
        verdict = "wrong coordinates" if is_wrong else f"not {', '.join(beyond)}" if beyond else "yes"
        metres = " | ".join(f"{1000 * value:+.0f} mm" for value in off)
        lines.append(f"| {name} | {each['marks']} | {metres} | {1000 * std[2]:.0f} mm | {verdict} |")
    told = np.array([each["off_m"] for each in found["targets"].values() if np.abs(each["off_m"]).max() <= WRONG_M])
    rms = ", ".join(
        f"{axis} {1000 * value:.0f} mm" for axis, value in zip(AXES, np.sqrt((told**2).mean(axis=0)), strict=True)
    )
    named = [f"Left in the control, the wrong one is named: {found['warnings'][0]}."] if found["warnings"] else []
    within = f"Heights of {inside} of {sound} sound targets lie within 1.96 standard deviations; rms {rms}."
    return [*lines, "", *fill(" ".join([within, *named]), WIDTH).split("\n")]


def shutter_rows(found: dict) -> list[str]:
    """What a block says of its shutter."""
    rolling = found["rolling"]
    rms = {name: 1000.0 * float(np.sqrt(np.mean(np.square(each["check_up_m"])))) for name, each in found.items()}
    said = (
        f"Asked for a rolling shutter (a readout of 30 ms, known to 30 ms, at 12 m/s), the block answers "
        f"{1000 * rolling['readout_s']:.1f} ms ± {1000 * rolling['std_s']:.1f} ms; heights of the check targets have "
        f"an rms of {rms['global']:.0f} mm with a global shutter and {rms['rolling']:.0f} mm with that."
    )
    return fill(said, WIDTH).split("\n")


def stream_rows(found: dict) -> list[str]:
    """Points of other programs."""
    apart, ratio = found["per_camera_apart_m"], found["bent_over_straight"]
    said = (
        f"Corrected by every camera as pyBathySfM does it, {found['points']:,} points of a stream lie within "
        f"{1000 * apart:.1f} mm of its own depths; bent rays put them at {ratio:.3f} of the depth of straight ones."
    )
    lines = [
        *fill(said, WIDTH).split("\n"),
        "",
        f"| heights of {found['heads']} heads of coral, against a tape | rms |",
        "|---|---|",
    ]
    return [*lines, *(f"| {name} | {100 * rms:.1f} cm |" for name, rms in found["palau_rms_m"].items())]


TABLES = {"greenland": profile_rows, "targets": target_rows, "shutter": shutter_rows, "streams": stream_rows}


def marks(name: str) -> tuple[str, str]:
    """The lines between which a table of this name stands."""
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def publish(page: Path, name: str, lines: list[str]) -> None:
    """Write lines of Markdown between the marks of a page; the rest of it stays.

    Raises
    ------
    SystemExit
        If the page has no such marks.
    """
    (begin, end), text = marks(name), page.read_text(encoding="utf-8")
    head, found, rest = text.partition(begin)
    _, ended, tail = rest.partition(end)
    if not (found and ended):
        raise SystemExit(f"{page} has no lines {begin} and {end}, between which the table is written; add them")
    page.write_text("\n".join([f"{head}{begin}", "", *lines, "", f"{end}{tail}"]), encoding="utf-8")


def tables() -> dict[tuple[Path, str], list[str]]:
    """All tables, by the page and the name of the marks that they stand between."""
    quick, drawn = (read_results(RESULTS / f"{name}.json") for name in ("quick", "drawn"))
    real = json.loads((RESULTS / "real.json").read_text(encoding="utf-8"))
    page = DOCS / "benchmark.md"
    found = {
        (page, "quick"): quick_rows(quick.records),
        (page, "straight"): straight_rows((*quick.records, *drawn.records)),
        (page, "drawn"): drawn_rows(drawn.records),
    }
    tiles = json.loads((RESULTS / "tiles.json").read_text(encoding="utf-8"))
    found[DOCS / "scaling.md", "tiles"] = tile_rows(tiles)
    peers = json.loads((RESULTS / "peers.json").read_text(encoding="utf-8"))
    found[DOCS / "performance.md", "peers"] = peer_rows(peers)
    return found | {(DOCS / "real.md", name): rows(real[name]) for name, rows in TABLES.items()}


def quick_rows(records: tuple[Record, ...]) -> list[str]:
    """Time, memory and errors of methods on data/quick."""
    lines = [
        "| method | quality | time | memory | mean | std | complete at 0.2, 0.05 m |",
        "|---|---|---|---|---|---|---|",
    ]
    for method, quality in QUICK:
        record = next(r for r in records if (r.method, r.quality, r.poses) == (method, quality, "given"))
        errors, cost = record.errors, record.costs[0]
        shares = ", ".join(f"{100.0 * errors.completeness[key]:.1f}" for key in ("0.2", "0.05"))
        lines.append(
            f"| {METHODS[method].words} | {quality} | {cost.wall_s:.0f} s | {cost.peak_bytes / 1e9:.2f} GB | "
            f"{1000.0 * errors.mean_m:.1f} mm | {1000.0 * errors.std_m:.1f} mm | {shares} % |"
        )
    return lines


def straight_rows(records: tuple[Record, ...]) -> list[str]:
    """Median vertical errors of straight rays, as they are and corrected, at standard quality."""
    lines = ["| survey | straight rays | of the depth | depth times n | per camera |", "|---|---|---|---|---|"]
    for case, words, depth_m in STRAIGHT:
        median = {r.method: r.errors.median_m for r in records
                  if (r.case, r.quality, r.poses) == (case, "standard", "given")}  # fmt: skip
        mm = [f"{1000.0 * median[method]:.0f} mm" for method in ("straight", "times_index", "per_camera")]
        lines.append(f"| {words} | {mm[0]} | {100.0 * median['straight'] / depth_m:.0f} % | {mm[1]} | {mm[2]} |")
    return lines


def drawn_rows(records: tuple[Record, ...]) -> list[str]:
    """The whole chain on drawn surveys, given poses: draft and, of 20 photographs, standard."""
    lines = [
        "| depth, photographs | quality | processor time | mean | std | complete at 0.05 m | std covers |",
        "|---|---|---|---|---|---|---|",
    ]
    for record in records:
        _, depth, pattern, number = record.case.split("_")
        errors, cost = record.errors, record.costs[0]
        if record.method != "full" or record.poses != "given" or (number == "20" and record.quality == "draft"):
            continue
        lines.append(
            f"| {depth} m, {number} {pattern} | {record.quality} | {cost.processor_s:.0f} s | "
            f"{1000.0 * errors.mean_m:.1f} mm | {1000.0 * errors.std_m:.1f} mm | "
            f"{100.0 * errors.completeness['0.05']:.1f} % | {100.0 * errors.coverage:.0f} % |"
        )
    return lines


def tile_rows(found: dict) -> list[str]:
    """A survey in tiles against the same in one piece."""
    one, many = ({row["tiles"]: row for row in found["runs"]}[tiles] for tiles in (1, found["tiles"]))
    steps = [max(abs(step) for step in row["steps_mm"]) for row in (many, one)]

    def times(key: str) -> float:
        return many[key] / one[key]

    def reached(key: str) -> str:
        return f"{100.0 * many['completeness'][key]:.2f} for {100.0 * one['completeness'][key]:.2f} %"

    return [
        f"| {found['tiles']} tiles against one piece | data/{found['survey']}, {found['quality']} |",
        "|---|---|",
        f"| std of the inner 90 % | {many['std_mm']:.2f} for {one['std_mm']:.2f} mm |",
        f"| complete at 0.05 m | {reached('0.05')} |",
        f"| largest step at a line (medians of 0.5 m on either side) | {steps[0]:.2f} for {steps[1]:.2f} mm |",
        f"| processor time | {many['processor_s']:.0f} for {one['processor_s']:.0f} s, "
        f"{times('processor_s'):.2f} times |",
        f"| peak of memory | {many['memory_bytes'] / 1e9:.2f} for {one['memory_bytes'] / 1e9:.2f} GB |",
    ]


def peer_rows(found: dict) -> list[str]:
    """What the same work costs by ours and by other programs; the first row of each work is ours."""
    words = {
        "adjustment": "adjustment, {size} photographs",
        "c2m": f"C2M, {found['points']:,} points",
        "laz": f"LAZ, {9 * found['points'] / 1e6:.1f} million points",
        "dense": "dense, demo, draft",
    }
    lines = [
        "| work | program | processor [s] | wall [s] | memory [GB] | error [mm] | ours/theirs |",
        "|---|---|---|---|---|---|---|",
    ]
    ours: dict = {}
    for row in found["rows"]:
        is_ours = row["program"] == "bathynerf"
        ours = row if is_ours else ours
        work = words[row["work"]].format(size=row["size"]) if is_ours else ""
        # Of AquaMVS one photograph of 20.
        times = 20 if row["program"].startswith("aquamvs") else 1
        program = row["program"].split()[0] + (" (1/20)" if times > 1 else "")
        ratio = "" if is_ours else f"{ours['cpu_s'] / (times * row['cpu_s']):.2g}"
        lines.append(
            f"| {work} | {program} | {row['cpu_s']:.2g} | {row['wall_s']:.2g} | {row['peak_mb'] / 1e3:.2f} | "
            f"{row['accuracy']} | {ratio} |"
        )
    missing = ", ".join(found["missing"])
    return [*lines, *(["", f"Left out, as they were not installed: {missing}."] if missing else [])]


def main() -> None:
    """Write them."""
    for (page, name), lines in tables().items():
        publish(page, name, lines)


if __name__ == "__main__":
    main()
