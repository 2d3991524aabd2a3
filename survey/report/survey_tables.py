"""The tables of report.html about the cloud, the survey, the plan and the run, from the figures of a report."""

from __future__ import annotations

import json

from survey.display.quantities import LengthUnit, count, length, metres, number, with_unit
from survey.report.blocks import Block, Rows, Table

# Digits of coordinates by their unit: to the centimetre in metres, to about as much in degrees.
_DECIMALS = {"m": 2, "°": 7}
_AXES = ("easting", "northing", "height")
# Longer runs are written in minutes [s].
_LONG_S = 600.0


def cloud(c: dict, crs: dict) -> list[Block]:
    """Number of points, density, extent, and how depth, spread, views and incidence are distributed."""
    rows = [("points", f"{count(c['points'])}: {count(c['points_wet'])} wet, {count(c['points_dry'])} dry")]
    if c["density_per_m2"]:
        rows.append(("density", f"{count(c['density_per_m2'])} points per m² over {count(c['covered_area_m2'])} m²"))
    return [Rows(rows), *_distributions(c), *_extent(c["extent"], crs)]


def _distributions(c: dict) -> list[Table]:
    std = LengthUnit.of((c["std_m"] or {}).values())
    kinds = (
        ("depth_m", "true depth [m]", lambda v: number(v, 2)),
        ("std_m", f"standard deviation [{std.name}]", std.number),
        ("views_per_point", "views per point", lambda v: number(v, 0)),
        ("incidence_deg", "incidence [°]", lambda v: number(v, 1)),
    )
    statistics = ("min", "median", "p95", "max")
    rows = [
        (label, *(show(c[key][name]) if name in c[key] else "" for name in statistics))
        for key, label, show in kinds if c[key]
    ]  # fmt: skip
    return [Table(("over all points", "lowest", "median", "95 % below", "highest"), rows)] if rows else []


def _extent(extent: dict | None, crs: dict) -> list[Table]:
    if not extent:
        return []
    units = (crs["unit"], crs["unit"], crs["height_unit"])
    rows = []
    for name, unit, low, high in zip(_AXES, units, extent["low"], extent["high"], strict=True):
        digits = _DECIMALS.get(unit, 2)
        rows.append((f"{name} [{unit}]", number(low, digits), number(high, digits), number(high - low, digits)))
    return [Table(("extent", "from", "to", "size"), rows)]


def survey(s: dict, water: dict | None, plan: dict) -> list[Block]:
    """Where, with what, from how high, and through which water."""
    crs = s["crs"]
    width, height = s["image_size_px"]
    size = " x ".join(number(side, 1) for side in plan["footprint_m"])
    rows = [
        ("coordinate reference system", crs["name"] + (f", {crs['code']}" if crs["code"] else "")),
        ("photographs", f"{s['views_used']} used, {s['views_left_out']} left out"),
        ("images", f"{width} x {height} px, focal length {s['focal_px']:.1f} px"),
        ("poses", s["poses"]),
        ("flying height", f"{with_unit(number(plan['height_m'], 1), 'm')}, one image covers {with_unit(size, 'm')}"),
        ("ground sampling distance", length(plan["gsd_m"])),
    ]
    if s["bounds"]:
        e0, n0, e1, n1 = (number(v, _DECIMALS.get(crs["unit"], 2)) for v in s["bounds"])
        rows.append(("bounds", f"{e0} to {e1} east, {n0} to {n1} north"))
    if water is None:
        return [Rows([*rows, ("water", "none: a dry survey")])]
    at = ", ".join(number(v, _DECIMALS.get(crs["unit"], 2)) for v in water["level_at"])
    slope = f"{water['slope_east']:g} to the east, {water['slope_north']:g} to the north"
    rows += [
        ("water level", f"{metres(water['level_m'])} at {at} ({water['level_from']})"),
        ("slope of the water", f"{slope} ({water['slope_from']})"),
        ("refractive index", f"{water['refractive_index']:.4f} ({water['refractive_index_from']})"),
    ]
    return [Rows(rows)]


def decisions(plan: list[dict]) -> list[Block]:
    """The plan with its reasons."""
    return [Table(("decision", "choice", "reason"), [(d["name"], d["choice"], d["reason"]) for d in plan], num_texts=3)]


def timings(seconds: dict[str, float]) -> list[Block]:
    """How long each stage took when it was computed, in one unit."""
    is_long = seconds["total"] >= _LONG_S
    unit, factor = ("min", 1.0 / 60.0) if is_long else ("s", 1.0)
    rows = [(name.replace("_", " "), number(value * factor, 1)) for name, value in seconds.items()]
    return [Table(("stage", f"time [{unit}]"), rows)]


def settings(values: dict, prefix: str = "") -> str:
    """Settings as lines of ``section.key = value``, those without a value left out."""
    lines = []
    for name, value in values.items():
        if isinstance(value, dict):
            lines.append(settings(value, f"{prefix}{name}."))
        elif value is not None:
            lines.append(f"{prefix}{name} = {json.dumps(value, ensure_ascii=False)}")
    return "\n".join(line for line in lines if line)
