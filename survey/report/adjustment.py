"""An adjustment in a report: parameters, observations, positions, poses, control and correlations, and their tables."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from survey.adjust.block.on_ground import NAMES, GroundFit
from survey.adjust.block.state import NUM_RELIEF
from survey.adjust.result.adjustment import Adjustment, ControlResidual, Parameter, Status
from survey.adjust.result.parts import Part, common_error, parts_of_adjustment
from survey.display.blocks import Block, Rows, Sentences, Table, Text
from survey.display.quantities import NO_BREAK, LengthUnit, count, decimals_of, length, number
from survey.folder.survey import Survey
from survey.report.checkpoints import CE95, LE95

# Parameters with a smaller standard deviation were held fixed.
_HELD_STD = 1e-7
# Some programs write a camera per photograph, for which pictures would become too wide.
MOST_LENSES = 4


def adjustment_of(survey: Survey, found: Adjustment | None) -> dict[str, Any] | None:
    """The figures of an adjustment, by their keys in report.json; None where there was none.

    Axes are east, north, up [m], or x, y, z of the camera [deg]. `factor` of observations is the variance inflation for
    correlated errors of neighbours.
    """
    if found is None:
        return None
    (names, correlation), statistics = correlations(found), found.statistics
    common = common_error(found, survey.water)
    return {
        "parameters": found.parameters,
        "kinds": [
            {"name": name, "num": num, "std_px": statistics.std_px[name], "factor": statistics.variance_factor[name]}
            for name, num in statistics.num_observations.items()
        ],
        "num_points": statistics.num_points,
        "num_left_out": statistics.num_left_out,
        "positions": _positions(survey, found),
        "poses": _poses(found),
        "control": found.control,
        "control_groups": _control_groups(found.control),
        "parts": parts_of_adjustment(found, survey.water),
        "correlation_names": names,
        "correlation": correlation.tolist(),
        "ground": found.ground,
        "height_std_common_m": None if common is None else {"mean": common.mean, "typical": common.typical},
    }


def shown_lenses(found: Adjustment) -> list[int]:
    """Lenses of pictures and tables: those with the most residuals, `MOST_LENSES` at most."""
    count = np.bincount(found.poses.lens_of[found.residuals.view], minlength=len(found.lenses))
    return sorted(np.argsort(-count, kind="stable")[:MOST_LENSES].tolist())


def correlations(found: Adjustment) -> tuple[tuple[str, ...], np.ndarray]:
    """Names (K,) and correlations (K, K) of the parameters of water and lenses that were estimated.

    Of many lenses those of `shown_lenses`; without focal lengths of single photographs.
    """
    layout = found.layout
    count = layout.first_focal - NUM_RELIEF
    std = np.sqrt(np.diag(found.covariance.matrix)[:count])
    for lens in set(range(len(layout.aspect))) - set(shown_lenses(found)):
        own = layout.lens(lens)
        std[own.start - NUM_RELIEF : own.stop - NUM_RELIEF] = 0.0
        if layout.finds_readouts:
            std[layout.first_readout + lens - NUM_RELIEF] = 0.0
    free = np.flatnonzero(std > _HELD_STD)
    matrix = found.covariance.matrix[np.ix_(free, free)] / np.outer(std[free], std[free])
    return tuple(found.covariance.names[i] for i in free), matrix


def _positions(survey: Survey, found: Adjustment) -> dict[str, Any] | None:
    """Adjusted less given positions, without the common error of heights; None where none were given."""
    given = {name: prior.position for name, prior in survey.observations.priors.items() if prior.position is not None}
    rows = [i for i, name in enumerate(found.poses.names) if name in given]
    if not rows:
        return None
    residual = found.poses.centres[rows] - np.array([given[found.poses.names[i]] for i in rows])
    residual[:, 2] += 0.0 if found.common_up_m is None else found.common_up_m[0]
    return {
        "num": len(rows),
        "used_std_m": found.statistics.gps_std_m,
        "rms_m": _rms(residual),
        **_largest(residual, [found.poses.names[row] for row in rows], "largest", "_m"),
        "common_up_m": found.common_up_m,
    }


def _poses(found: Adjustment) -> dict[str, Any]:
    """Medians of the standard deviations of poses, and the largest."""
    position, rotation, names = found.poses.position_std, found.poses.rotation_std_deg, found.poses.names
    return {
        "position_m": np.median(position, axis=0).tolist(),
        "rotation_deg": np.median(rotation, axis=0).tolist(),
        **_largest(position, names, "largest_position", "_m"),
        **_largest(rotation, names, "largest_rotation", "_deg"),
    }


def _largest(values: np.ndarray, names: Sequence[str], key: str, unit: str) -> dict[str, Any]:
    """The largest length of some vectors (N, 3), and the photograph that has it."""
    lengths = np.linalg.norm(values, axis=1)
    worst = int(np.argmax(lengths))
    return {f"{key}{unit}": float(lengths[worst]), f"{key}_name": names[worst]}


def _control_groups(control: tuple[ControlResidual, ...]) -> list[dict[str, Any]]:
    """All control points, and all check points, within how far 95 % of normal errors are with these residuals."""
    groups = []
    for name, is_check in (("control", False), ("check", True)):
        rows = [row for row in control if row.is_check == is_check]
        if rows:
            marks = np.array([row.num_marks for row in rows])
            squares = np.array([row.rms_px for row in rows]) ** 2
            rms = _rms(np.array([row.residual_m for row in rows]))
            groups.append({
                "name": name,
                "num": len(rows),
                "rms_m": rms,
                "rms_px": float(np.sqrt((marks * squares).sum() / max(marks.sum(), 1))),
                "ce95_m": CE95 * math.hypot(rms[0], rms[1]) / math.sqrt(2.0),
                "le95_m": LE95 * rms[2],
            })  # fmt: skip
    return groups


def _rms(values: np.ndarray) -> list[float]:
    return np.sqrt(np.mean(values**2, axis=0)).tolist()


def adjustment(found: dict[str, Any] | None) -> list[Block]:
    """Tables of the figures of an adjustment; nothing where there was none."""
    if found is None:
        return []
    blocks: list[Block] = []
    if (common := found["height_std_common_m"]) is not None:
        note = (
            f"Standard deviation by water, lens and poses: {length(common['mean'])} of the mean height, "
            f"{length(common['typical'])} of a typical height; matching errors add to it."
        )
        blocks.append(Text(note))
    if parameters := found["parameters"]:
        # The table has what the sentences of the others say.
        unknown = [f"{row.name} {row.verdict}" for row in parameters if row.status == Status.UNKNOWN]
        blocks += [parameter_table(parameters), *([Sentences(unknown)] if unknown else [])]
    observations = Table(
        ("observations", "number", "1 sigma [px]", "variance factor (correlated errors)"),
        [
            *((row["name"], count(row["num"]), number(row["std_px"], 2), number(row["factor"], 1))
              for row in found["kinds"]),
            ("left out as outliers", count(found["num_left_out"]), "", ""),
        ],
        heading=f"Observations of {count(found['num_points'])} points",
    )  # fmt: skip
    blocks += [*_parts(found["parts"]), observations, Rows([*_position_rows(found["positions"]), *_pose_rows(found)])]
    return [*blocks, *_ground(found["ground"]), *_control(found)]


def _parts(parts: Sequence[Part]) -> list[Block]:
    """The parts of a block that falls apart; nothing of a whole one."""
    if not parts:
        return []
    stds = [std for part in parts for std in (part.height_std_m, part.to_first_std_m) if std is not None]
    unit, far = LengthUnit.of(stds), LengthUnit.of_heights()
    rows = [
        (str(place), part.listed, count(len(part.names)), count(part.num_points),
         number(part.apart_m * far.per_metre, 1), unit.number(part.height_std_m), unit.number(part.to_first_std_m))
        for place, part in enumerate(parts, start=1)
    ]  # fmt: skip
    titles = (
        "part", "photographs", "number", "points", f"to the next part [{far.name}]", f"height, 1 sigma [{unit.name}]",
        f"less that of part 1, 1 sigma [{unit.name}]",
    )  # fmt: skip
    message = "No point is seen by photographs of two parts: positions, control and water alone hold these together."
    return [Text(message), Table(titles, rows, num_texts=2, heading="Parts without common tie points")]


def parameter_table(parameters: Sequence[Parameter]) -> Table:
    """Values and standard deviations, found and given."""
    titles, rows = ("parameter", "status", "value", "1 sigma", "given", "1 sigma of the given"), []
    for row in parameters:
        if row.given_std is not None and row.given_std < _HELD_STD:
            numbers = [f"{row.value:.6g}", "exact", f"{row.given:.6g}", "exact"]
        else:
            numbers = [number(value, decimals_of(row.std)) for value in (row.value, row.std, row.given)]
            numbers.append(number(row.given_std, decimals_of(row.given_std)))
        rows.append((row.name, row.status, *numbers))
    return Table(titles, rows, num_texts=2, heading="Water and lens")


def _position_rows(given: dict[str, Any] | None) -> list[tuple[str, str]]:
    if given is None:
        return []
    rows = []
    if given["used_std_m"] is not None:
        rows.append(("given positions, 1 sigma as used", f"{_axes_text(given['used_std_m'])} (median)"))
    if given["common_up_m"] is not None:
        error, std = given["common_up_m"]
        side = "low" if error < 0.0 else "high"
        rows.append(("heights of given positions", f"all {length(abs(error))} too {side}, ± {length(std)}"))
    largest = f"the largest is {length(given['largest_m'])}, of {given['largest_name']}"
    return [*rows, ("adjusted less given positions", f"rms {_axes_text(given['rms_m'])}; {largest}")]


def _pose_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    poses = found["poses"]
    largest = f"at most {length(poses['largest_position_m'])} together, of {poses['largest_position_name']}"
    turns = " / ".join(number(1000.0 * value, 1) for value in poses["rotation_deg"])
    most = f"{number(1000.0 * poses['largest_rotation_deg'], 1)} together, of {poses['largest_rotation_name']}"
    return [
        ("1 sigma of positions", f"{_axes_text(poses['position_m'])} (median); {largest}"),
        ("1 sigma of rotations", f"{turns} thousandths of a degree about x, y, z (median); at most {most}"),
    ]


def _axes_text(values: Sequence[float]) -> str:
    unit = LengthUnit.of(values)
    return f"{' / '.join(unit.number(value) for value in values)}{NO_BREAK}{unit.name} east / north / up"


def _ground(fit: GroundFit | None) -> list[Table]:
    """The transformation onto an earlier survey."""
    if fit is None:
        return []
    without = (None,) * len(NAMES) if fit.std_without is None else fit.std_without
    rows = []
    for name, moved, std, before in zip(NAMES, fit.moved, fit.std, without, strict=True):
        part, unit = name.rsplit("_", 1)
        values = (number(moved, decimals_of(std)), number(std, decimals_of(std)), number(before, decimals_of(before)))
        rows.append((f"{part.replace('_', ' about ')} [{unit}]", *values))
    heading = (
        f"Placement on {fit.reference}: {count(fit.num_points)} points, {length(fit.rms_m)} rms from its ground "
        f"({count(fit.num_changed)} of {count(fit.num_over)} tie points over it left out)"
    )
    return [Table(("part", "moved by", "1 sigma", "1 sigma without placement"), rows, heading=heading)]


def _control(found: dict[str, Any]) -> list[Table]:
    control: Sequence[ControlResidual] = found["control"]
    if not control:
        return []
    unit = LengthUnit.of([value for row in control for value in row.residual_m])
    axes = tuple(f"{axis} [{unit.name}]" for axis in ("east", "north", "up"))
    rows = [
        (f"{group['name']} points", count(group["num"]),
         *(unit.number(value) for value in (*group["rms_m"], group["ce95_m"], group["le95_m"])),
         number(group["rms_px"], 2))
        for group in found["control_groups"]
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
            for row in control if row.is_check == is_check
        ]  # fmt: skip
        if rows:
            tables.append(Table(("point", "lies", *axes, "marks", "rms [px]"), rows, num_texts=2, heading=heading))
    return tables
