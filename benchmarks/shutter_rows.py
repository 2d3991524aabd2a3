"""Rows of bench_adjust.py about rolling shutters: one flight at 5 m/s, photographed with a shutter that rolls and not.

quick's size, 21 photographs from 22 m over the water, each flown in another direction; XMP has the speeds to 0.1 m/s.
With _noisy behind it a row has errors of 2 cm and 0.02 degrees in its poses, stated; with _gps it has the photographs
and their GPS of 2 cm alone.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from adjust_rows import GPS_STD_M, Row, Truth, linked, noisy, settings_of, true_lens, true_water

from survey.simulate.drawn import DrawnScene, draw_survey

READOUT_S, SPEED_M_S = 0.03, 5.0
EXACT, NOISY, GPS = "", "_noisy", "_gps"
# What the survey says of its shutter: how it is drawn [s], and keys of [cameras].
SAID: dict[str, tuple[float, dict[str, float]]] = {
    "shutter_global": (0.0, {"rolling_shutter_s": 0.0}),
    "shutter_known": (READOUT_S, {"rolling_shutter_s": READOUT_S}),
    "shutter_found": (READOUT_S, {"rolling_shutter_s": 0.02, "rolling_shutter_std_s": 0.02}),
    "shutter_ignored": (READOUT_S, {}),
}


def _row(name: str, folder: Path, *, poses: str) -> Row:
    readout, keys = SAID[name]
    source = folder.parent.parent / f"drawn_{readout:g}"
    scene = DrawnScene(
        num_views=21, flying_m=22.0, focal_px=900.0, image_px=(600, 450), seed=41, speed_m_s=SPEED_M_S,
        readout_s=readout,
    )  # fmt: skip
    draw_survey(source, scene)
    table = settings_of(source)
    true = Truth(
        water=true_water(table["water"]),
        lens=true_lens(table["cameras"]) | {"readout_s": readout},
        cameras=source / "cameras.csv",
        reference=source / "truth" / "reference.ply",
        visible=source / "truth" / "visible.ply",
    )
    table["cameras"].pop("rolling_shutter_s", None)
    table["cameras"] |= keys
    if poses == NOISY:
        noisy(source, folder, table)
    elif poses == GPS:
        del table["cameras"]["poses"]
        table["cameras"]["position_std_m"] = GPS_STD_M
        linked(source, folder, table)
    else:
        linked(source, folder, table, "cameras.csv")
    return Row(folder, true)


SHUTTER_ROWS: dict[str, Callable[[Path], Row]] = {
    name + poses: partial(_row, name, poses=poses) for poses in (EXACT, NOISY, GPS) for name in SAID
}
