"""Tables of docs/real.md from the results of bench_real.py."""

from __future__ import annotations

from textwrap import fill

import numpy as np

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
