"""The tables of report.html about the adjustment."""

from __future__ import annotations

import math
from collections.abc import Sequence

from survey.adjust.block.on_ground import NAMES
from survey.adjust.result.adjustment import Parameter
from survey.display.blocks import Block, Rows, Sentences, Table, Text
from survey.display.quantities import NO_BREAK, LengthUnit, count, is_known, length, number
from survey.report.adjustment_figures import HELD_STD, AdjustmentFigures


def adjustment(found: AdjustmentFigures | None) -> list[Block]:
    """Tables of the adjustment; nothing where there was none."""
    if found is None:
        return []
    blocks: list[Block] = []
    if found.note is not None:
        blocks.append(Text(found.note[0].upper() + found.note[1:] + "."))
    if found.parameters:
        verdicts = Sentences([f"{row.name} {row.verdict}" for row in found.parameters])
        blocks += [parameter_table(found.parameters), verdicts]
    return [*blocks, *_parts(found), _observations(found), Rows(_poses(found)), *_ground(found), *_control(found)]


def _parts(found: AdjustmentFigures) -> list[Block]:
    """The parts of a block that falls apart."""
    if not found.parts:
        return []
    stds = [std for part in found.parts for std in (part.height_std_m, part.to_first_std_m) if std is not None]
    unit, far = LengthUnit.of(stds), LengthUnit.of_heights()

    rows = [
        (str(place), part.listed, count(len(part.names)), count(part.num_points),
         number(part.apart_m * far.per_metre, 1), unit.number(part.height_std_m), unit.number(part.to_first_std_m))
        for place, part in enumerate(found.parts, start=1)
    ]  # fmt: skip
    titles = (
        "part", "photographs", "number", "points", f"to the next part [{far.name}]", f"height, 1 sigma [{unit.name}]",
        f"less that of part 1, 1 sigma [{unit.name}]",
    )  # fmt: skip
    message = "No point is seen by photographs of two parts: positions, control and water alone hold these together."
    return [Text(message), Table(titles, rows, num_texts=2, heading="Parts without common tie points")]


def parameter_table(parameters: Sequence[Parameter]) -> Table:
    """Values and standard deviations, found and given."""
    titles = ("parameter", "status", "value", "1 sigma", "given", "1 sigma of the given")
    return Table(titles, [_parameter(row) for row in parameters], num_texts=2, heading="Water and lens")


def _parameter(row: Parameter) -> tuple[str, ...]:
    if row.given_std is not None and row.given_std < HELD_STD:
        return (row.name, row.status, f"{row.value:.6g}", "exact", f"{row.given:.6g}", "exact")
    digits = _digits(row.std)
    given_std = number(row.given_std, _digits(row.given_std))
    value, std, given = number(row.value, digits), number(row.std, digits), number(row.given, digits)
    return (row.name, row.status, value, std, given, given_std)


def _digits(std: float | None) -> int:
    """Decimals that show two digits of a standard deviation."""
    return min(max(1 - math.floor(math.log10(std)), 0), 9) if is_known(std) and std > 0.0 else 4


def _observations(found: AdjustmentFigures) -> Table:
    titles = ("observations", "number", "1 sigma [px]", "variance factor (correlated errors)")
    rows = [(row.name, count(row.num), number(row.std_px, 2), number(row.factor, 1)) for row in found.kinds]
    rows.append(("left out as outliers", count(found.num_left_out), "", ""))
    return Table(titles, rows, heading=f"Observations of {count(found.num_points)} points")


def _poses(found: AdjustmentFigures) -> list[tuple[str, str]]:
    rows = []
    if (given := found.positions) is not None:
        if given.used_std_m is not None:
            rows.append(("given positions, 1 sigma as used", f"{_axes_text(given.used_std_m)} (median)"))
        if given.common_up_m is not None:
            error, std = given.common_up_m
            side = "low" if error < 0.0 else "high"
            rows.append(("heights of given positions", f"all {length(abs(error))} too {side}, ± {length(std)}"))
        largest = f"the largest is {length(given.largest_m)}, of {given.largest_name}"
        rows.append(("adjusted less given positions", f"rms {_axes_text(given.rms_m)}; {largest}"))
    poses = found.poses
    largest = f"at most {length(poses.largest_position_m)} together, of {poses.largest_position_name}"
    rows.append(("1 sigma of positions", f"{_axes_text(poses.position_m)} (median); {largest}"))
    turns = " / ".join(number(1000.0 * value, 1) for value in poses.rotation_deg)
    most = f"{number(1000.0 * poses.largest_rotation_deg, 1)} together, of {poses.largest_rotation_name}"
    rows.append(("1 sigma of rotations", f"{turns} thousandths of a degree about x, y, z (median); at most {most}"))
    return rows


def _axes_text(values: Sequence[float]) -> str:
    unit = LengthUnit.of(values)
    return f"{' / '.join(unit.number(value) for value in values)}{NO_BREAK}{unit.name} east / north / up"


def _ground(found: AdjustmentFigures) -> list[Table]:
    """The transformation onto an earlier survey."""
    fit = found.ground
    if fit is None:
        return []
    without = (None,) * len(NAMES) if fit.std_without is None else fit.std_without
    rows = []
    for name, moved, std, before in zip(NAMES, fit.moved, fit.std, without, strict=True):
        part, unit = name.rsplit("_", 1)
        values = (number(moved, _digits(std)), number(std, _digits(std)), number(before, _digits(before)))
        rows.append((f"{part.replace('_', ' about ')} [{unit}]", *values))
    heading = (
        f"Placement on {fit.reference}: {count(fit.num_points)} points, {length(fit.rms_m)} rms from its ground "
        f"({count(fit.num_changed)} of {count(fit.num_over)} tie points over it left out)"
    )
    return [Table(("part", "moved by", "1 sigma", "1 sigma without placement"), rows, heading=heading)]


def _control(found: AdjustmentFigures) -> list[Table]:
    if not found.control:
        return []
    unit = LengthUnit.of([value for row in found.control for value in row.residual_m])
    axes = tuple(f"{axis} [{unit.name}]" for axis in ("east", "north", "up"))
    rows = [
        (f"{group.name} points", count(group.num),
         *(unit.number(value) for value in (*group.rms_m, group.ce95_m, group.le95_m)), number(group.rms_px, 2))
        for group in found.control_groups
    ]  # fmt: skip
    spread = tuple(f"{name} [{unit.name}]" for name in ("plan, 95 %", "height, 95 %"))
    titles = ("rms of", "number", *axes, *spread, "marks [px]")
    tables = [Table(titles, rows, heading="Control and check points")]
    for is_check, heading in (
        (False, "Control points, adjusted to, not independent: adjusted less given"),
        (True, "Check points with marks, not adjusted to: adjusted less given"),
    ):
        rows = [
            (row.name, "under water" if row.is_wet else "dry", *(unit.number(value) for value in row.residual_m),
             count(row.num_marks), number(row.rms_px, 2))
            for row in found.control if row.is_check == is_check
        ]  # fmt: skip
        if rows:
            tables.append(Table(("point", "lies", *axes, "marks", "rms [px]"), rows, num_texts=2, heading=heading))
    return tables
