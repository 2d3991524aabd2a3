"""The tables of report.html about the cloud, the survey, the plan, the run, and the distance to a reference."""

from dataclasses import replace
from typing import Any

from survey.display.blocks import Block, Rows, Table, Text
from survey.display.quantities import LengthUnit, area, count, density, distance, height, length, number, share, volume
from survey.plan.plan import Plan
from survey.report.checkpoints import MOST_ROWS, CheckpointAccuracy
from survey.report.facts import WaveFigures

# Digits of coordinates by their unit: to the centimetre in metres, to about as much in degrees.
_DECIMALS = {"m": 2, "°": 7}
# Photons of a lidar as check points are hundreds; report.json has all.


def cloud(found: dict[str, Any], crs: dict[str, Any]) -> list[Block]:
    """Number of points, density, extent, and how depth, spread, views and incidence are distributed."""
    rows = [("points", f"{count(found['points'])}: {count(found['points_wet'])} wet, {count(found['points_dry'])} dry")]
    if found["density_per_m2"]:
        rows.append(("density", f"{density(found['density_per_m2'])} over {area(found['covered_area_m2'])}"))
    return [Rows(rows), *_distributions(found), *_extent(found["extent"], crs)]


def _distributions(found: dict[str, Any]) -> list[Table]:
    """A row for each quantity that is known; a statistic without it is left empty."""
    shift, heights, rows = found.get("plan_std_common_m"), LengthUnit.of_heights(), []
    for name, values, given_unit in (
        ("true depth", found["depth_m"], heights),
        ("standard deviation", found["std_m"], None),
        ("common standard deviation: water, lens, poses", found["std_common_m"], None),
        ("common shift in plan: datum transformation", shift and {"median": shift, "p95": shift}, heights),
        ("views per point", found["views_per_point"], LengthUnit("", 1.0, 0)),
        ("incidence", found["incidence_deg"], LengthUnit("°", 1.0, 1)),
    ):
        if values:
            shown = [values.get(statistic) for statistic in ("min", "median", "p95", "max")]
            unit = given_unit or LengthUnit.of(shown)
            label = f"{name} [{unit.name}]" if unit.name else name
            rows.append((label, *("" if value is None else unit.number(value) for value in shown)))
    return [Table(("over all points", "lowest", "median", "95 % below", "highest"), rows)] if rows else []


def _extent(extent: dict[str, Any] | None, crs: dict[str, Any]) -> list[Table]:
    if extent is None:
        return []
    units, rows = {"easting": crs["unit"], "northing": crs["unit"], "height": crs["height_unit"]}, []
    for (name, unit), low, high in zip(units.items(), extent["low"], extent["high"], strict=True):
        digits = _DECIMALS.get(unit, 2)
        rows.append((f"{name} [{unit}]", number(low, digits), number(high, digits), number(high - low, digits)))
    return [Table(("extent", "from", "to", "size"), rows)]


def coverage(found: dict[str, Any] | None, num_left_out: int) -> list[Block]:
    """Ground that photographs look at, with points and without by reason, and its water; nothing of no ground."""
    if found is None or not found["ground_m2"]:
        return []
    rows = []
    for label, of_m2 in {"points found": found["found_m2"], **found["reasons_m2"]}.items():
        name, _, meaning = label.partition(": ")
        rows.append((name, meaning, area(of_m2), share(of_m2 / found["ground_m2"])))
    others = []
    if found.get("wet_m2"):
        std = "" if found["water_std_m3"] is None else f" ± {volume(found['water_std_m3'])} (one sigma)"
        others.append(("water over the bed found", f"{volume(found['water_m3'])}{std} over {area(found['wet_m2'])}"))
    if num_left_out:
        others.append(("photographs without a pose", f"{num_left_out}: what they alone show is missing"))
    titles = ("ground", "what it means", "area", "of all that photographs look at")
    return [Table(titles, rows, num_texts=2), *([Rows(others)] if others else [])]


def survey(taken: dict[str, Any], water: dict[str, Any] | None, plan: Plan) -> list[Block]:
    """Section of the survey: place, cameras, flying height and water."""
    crs, decimals = taken["crs"], _DECIMALS.get(taken["crs"]["unit"], 2)
    columns, lines = taken["image_size_px"]
    size = " x ".join(distance(side) for side in plan.footprint_m)
    rows = [
        ("coordinate reference system", crs["name"] + (f", {crs['code']}" if crs["code"] else "")),
        ("photographs", f"{taken['views_used']} used, {taken['views_left_out']} left out"),
        ("images", f"{columns} x {lines} px, focal length {taken['focal_px']:.1f} px"),
        ("poses", taken["poses"]),
        ("flying height", f"{distance(plan.height_m)}, one image covers {size}"),
        ("ground sampling distance", length(plan.gsd_m)),
    ]
    if taken["shutter"] is not None:
        rows.append(("shutter", taken["shutter"]))
    if taken["bounds"] is not None:
        e0, n0, e1, n1 = (number(v, decimals) for v in taken["bounds"])
        rows.append(("bounds", f"{e0} to {e1} east, {n0} to {n1} north"))
    if water is None:
        return [Rows([*rows, ("water", "none: a dry survey")])]
    at = ", ".join(number(v, decimals) for v in water["level_at"])
    slope = f"{water['slope_east']:g} to the east, {water['slope_north']:g} to the north"
    rows += [
        ("water level", f"{height(water['level_m'])} at {at} ({water['level_from']})"),
        ("slope of the water", f"{slope} ({water['slope_from']})"),
        ("refractive index", f"{water['refractive_index']:.4f} ({water['refractive_index_from']})"),
    ]
    if water["light"] is not None:
        rows.append(("light that is matched", _light(water["light"])))
    return [Rows(rows)]


def _light(light: dict[str, Any]) -> str:
    """Wavelength that the index belongs to, and the change of depth by another convention."""
    shares = ", ".join(f"{name} {share(light[name])}" for name in ("red", "green", "blue"))
    message = f"{light['wavelength_nm']:.0f} nm: {shares} {'of the texture' if light['is_measured'] else 'by luma'}"
    moved = "" if light["over_sodium_m"] is None else f", or {length(light['over_sodium_m'])} at the median depth"
    return (
        f"{message}; the index belongs to it. At 589 nm, as in handbooks, it is {light['over_sodium']:.4f} less{moved}"
    )


def checkpoints(found: CheckpointAccuracy | None) -> list[Block]:
    """The cloud at the check points, all together and each; nothing without check points."""
    if found is None:
        return []
    unit = LengthUnit.of([row.difference_m for row in found.rows])
    num_outside = sum(row.is_outside and row.difference_m is None for row in found.rows)
    num_without = sum(row.difference_m is None for row in found.rows) - num_outside
    method = (
        f"Height of the cloud less that of the check point, by the plane through the nearest points within "
        f"{length(found.within_m)}; nothing is adjusted to check points."
    )
    if num_without:
        method += f" {num_without} of {len(found.rows)} have no value: the cloud does not surround them."
    if num_outside:
        method += f" {num_outside} of {len(found.rows)} lie outside [area] bounds."
    blocks: list[Block] = [Text(method)]
    shown, heading = found.rows, "Each check point"
    if len(shown) > MOST_ROWS:
        shown = tuple(sorted(shown, key=lambda row: -abs(row.difference_m or 0.0))[:MOST_ROWS])
        heading = f"The {MOST_ROWS} check points of the largest differences"
    if found.groups:
        groups = [
            (group.name, count(group.num),
             *(unit.number(value) for value in (group.mean_m, group.rms_m, group.largest_m, group.le95_m)))
            for group in found.groups
        ]  # fmt: skip
        names = (f"{name} [{unit.name}]" for name in ("mean", "RMS", "largest", "95 %"))
        blocks.append(Table(("check points", "compared", *names), groups))
    deep = replace(LengthUnit.of_heights(), decimals=3)
    rows = [
        (row.name, number(row.height, 3), deep.number(row.depth_m), unit.number(row.difference_m),
         unit.number(row.stated_m), unit.number(row.std_m) if row.std_m else "",
         "outside bounds" if row.is_outside else "")
        for row in shown
    ]  # fmt: skip
    titles = (
        "check point", "height in crs", f"depth [{deep.name}]", f"difference [{unit.name}]",
        f"std stated [{unit.name}]", f"its own std [{unit.name}]", "note",
    )  # fmt: skip
    return [*blocks, Table(titles, rows, heading=heading)]


def waves(found: WaveFigures | None) -> list[Block]:
    """The waves in words; nothing where the water was still."""
    if found is None or found.sea is None:
        return []
    axis_deg = found.sea["axis_deg"]
    rows = [
        ("photographs shifted by", f"{found.moved_px:.2f} px (one sigma), before a surface was found for each"),
        (
            "height of the bed, one sigma by waves",
            f"{length(found.still_std_m)}, of which {length(found.left_std_m)} are left",
        ),
        ("significant wave height", length(found.sea["significant_height_m"])),
        ("slope, root mean square", f"{found.sea['slope_rms']:.3f}"),
        ("wavelength at the peak", length(found.sea["peak_length_m"])),
        ("along", f"{axis_deg:.0f}° and {axis_deg + 180.0:.0f}° from north, clockwise"),
    ]
    return [Rows(rows)]
