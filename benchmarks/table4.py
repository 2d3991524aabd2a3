"""The study's Tables 3 and 4, repeated: wet and dry, bent and straight rays, by the sweep and by radiance fields.

    python benchmarks/table4.py [--full] [--chains C ...] [--quality Q] [--samples N] [-o FOLDER]
                                [--steps N] [--rays N] [--cells N] [--device D]

By default the two are drawn small; with --full they are wreck_water and wreck_dry of the survey data, of the study's
size (130 images of 1024 x 768). Chains: the sweep alone, with the field trained about its bed (field), or a model of
`bathynerf field`, which begins anywhere in a box about the bed, is trained --steps steps, and leaves out one photograph
in eight, whose PSNR is printed (Table 3). Runs lie in FOLDER and are used again. Prints a table in Markdown and writes
table4.json: the study's protocol (`study`), and ours (nothing dropped, nothing aligned), beside its figures.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import study

from evaluation import distance_statistics, distance_to_mesh, is_reached, sample_mesh
from fields.models import MODELS
from geo import read_cloud, read_reference
from survey.folder.survey import Survey, load_survey
from survey.plan.choices import RECIPES

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("BATHYNERF_DATA", ROOT.parent / "shared" / "data"))
TOLERANCE_M = 0.2
CHAINS = ("sweep", "field", *MODELS)
STUDY = {  # mean, std [m], completeness of the study's Table 4; both fields after a shift of 18.9 cm by hand
    ("dry", "sweep"): (0.0003, 0.006, 0.791),
    ("dry", "field"): (-0.030, 0.058, 0.881),
    ("wet straight", "sweep"): (1.092, 0.346, 0.638),
    ("wet straight", "field"): (0.706, 0.360, 0.831),
    # The study's field is Nerfacto, without a sweep.
    ("dry", "nerfacto"): (-0.030, 0.058, 0.881),
    ("wet straight", "nerfacto"): (0.706, 0.360, 0.831),
}
# PSNR [dB] of photographs that were left out: the study's Table 3.
STUDY_DB = {"dry": 23.34, "wet straight": 24.52}
HELD_EVERY = 8
KEYS = ("mean_m", "std_m", "completeness")


@dataclass(frozen=True)
class Case:
    """One row: a survey, with its rays bent or straight, with or without the field."""

    name: str
    chain: str
    folder: Path
    run: Path

    @property
    def is_volume(self) -> bool:
        """Whether a radiance field without the sweep."""
        return self.chain in MODELS


def cases(wet: Path, dry: Path, folder: Path, chains: list[str]) -> list[Case]:
    """All rows, with a copy of the wet survey whose rays are straight."""
    straight = folder / "straight"
    straight.mkdir(parents=True, exist_ok=True)
    for path in wet.iterdir():
        link = straight / path.name
        if path.name not in ("survey.toml", "bathynerf") and not link.exists():
            link.symlink_to(path.resolve())
    settings = (wet / "survey.toml").read_text(encoding="utf-8")
    settings, count = re.subn(r"refractive_index\s*=\s*[\d.]+", "refractive_index = 1.0", settings)
    if count != 1:
        raise SystemExit(f"{wet / 'survey.toml'} has {count} lines refractive_index, expected one")
    (straight / "survey.toml").write_text(settings, encoding="utf-8")
    places = {"dry": dry, "wet bent": wet, "wet straight": straight}
    return [
        Case(name, chain, place, folder / f"{name} {chain}".replace(" ", "_"))
        for chain in chains
        for name, place in places.items()
    ]


def process(case: Case, options: argparse.Namespace) -> None:
    """Run the case through the command line; a quality gate that fails (3) is a result too."""
    field = "mdw" if case.chain == "field" else "off"
    # Straight rays contradict the true poses, and adjusted ones would take up a part of the refraction.
    chosen = ["--poses", "fixed", "--field", field, "--quality", options.quality, "--device", options.device]
    bathynerf("process", case.folder, "-o", case.run, *chosen)


def train(case: Case, options: argparse.Namespace) -> None:
    """Train a radiance field on the poses and the water of the sweep's run, if it is not trained yet."""
    if (case.run / "report.json").is_file():
        return
    sweep = case.run.with_name(case.run.name.replace(case.chain, "sweep"))
    straight = ["--straight"] if case.name == "wet straight" else []
    if straight:  # of the bent run: its heights give the box, and nothing else
        sweep = sweep.with_name(sweep.name.replace("straight", "bent"))
    sizes = [f"--{name}={getattr(options, name)}" for name in ("steps", "rays", "cells", "device")]
    e0, n0, e1, n1 = load_survey(case.folder).bounds
    bounds = ["--bounds", *(str(v) for v in (e0, n0, e1, n1))]
    bathynerf(
        "field", sweep, "--model", case.chain, "-o", case.run, "--from-scratch", "--held-every", HELD_EVERY,
        *straight, *sizes, *bounds,
    )  # fmt: skip


def bathynerf(*arguments: object) -> None:
    """Run a command.

    Raises
    ------
    SystemExit
        If it ends with anything but 0 or 3.
    """
    command = [sys.executable, "-m", "bathynerf", *(str(each) for each in arguments), "-qq"]
    done = subprocess.run(command, check=False)
    if done.returncode not in (0, 3):
        raise SystemExit(f"{' '.join(command)} ended with exit code {done.returncode}")


def measure(case: Case, truth: Survey, reference: Path, samples: int, times_seen: tuple[int, int]) -> dict:
    """Figures of a cloud by the study's protocol and by ours, in the local frame of the wet survey."""
    frame = truth.frame
    mesh = read_reference(reference)
    vertices = frame.local_from_crs(mesh.vertices)
    record = {"survey": case.name, "chain": case.chain}
    if case.is_volume:
        report = json.loads((case.run / "report.json").read_text())
        record["held_out_db"] = float(np.mean(list(report["held_out_psnr_db"].values())))
        record["held_out_ssim"] = float(np.mean(list(report["held_out_ssim"].values()) or [np.nan]))
        if not report["points"]:
            return record | dict.fromkeys(("ours", "study"))
    cloud = frame.local_from_crs(read_cloud(case.run / "cloud.las").points)
    e0, n0, e1, n1 = truth.bounds
    corners = frame.local_from_crs([[e0, n0, frame.origin[2]], [e1, n1, frame.origin[2]]])[:, :2]
    middle, size = corners.mean(axis=0), np.abs(corners[1] - corners[0])
    ours = study.cropped(cloud, middle, *size)
    theirs = study.study_cloud(cloud, middle, wet=case.name != "dry", field=case.chain != "sweep")
    theirs = study.cropped(theirs, middle, *np.minimum(size, study.CROP_M))  # the reference ends there
    surface = study.cropped(sample_mesh(vertices, mesh.faces, samples)[0], middle, *np.minimum(size, study.OBJECT_M))
    record |= {"n_points": len(ours), "n_points_study": len(theirs)}
    for label, points in (("ours", ours), ("study", theirs)):
        distances = distance_to_mesh(points, vertices, mesh.faces).signed
        found, (mean, std) = distance_statistics(distances), study.trimmed(distances)
        record[label] = {
            "mean_m": found.mean_inner90_m,
            "std_m": found.std_inner90_m,
            "trimmed_mean_m": mean,
            "trimmed_std_m": std,
            "completeness": float(is_reached(surface, points, tolerance_m=TOLERANCE_M).mean()),
        }
    if case.name == "wet straight" and not case.is_volume:
        visible = frame.local_from_crs(read_reference(reference.with_name("visible.ply")).points)
        record["bias"] = asdict(study.straight_bias(ours, visible, truth, times_seen))
    return record


def table(records: list[dict]) -> str:
    """The records beside the study's figures."""
    rows = [
        "| survey | chain | study's own | its protocol, here | the same, 5 to 95 % | ours, nothing dropped "
        "| PSNR, study | PSNR, SSIM, here |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in records:
        own = STUDY.get((r["survey"], r["chain"]))
        cells = [_cell(*own) if own else "not given"]
        theirs, ours = (None if r[k] is None else _cell(*(r[k][n] for n in KEYS)) for k in ("study", "ours"))
        trimmed = None if r["study"] is None else _spread(r["study"]["trimmed_mean_m"], r["study"]["trimmed_std_m"])
        cells += [each or "no surface" for each in (theirs, trimmed, ours)]
        own_db = STUDY_DB.get(r["survey"]) if r["chain"] == "nerfacto" else None
        here = f"{r['held_out_db']:.1f} dB, {r['held_out_ssim']:.2f}" if "held_out_db" in r else ""
        cells += ["" if own_db is None else f"{own_db:.1f} dB", here]
        rows.append(f"| {r['survey']} | {r['chain']} | " + " | ".join(cells) + " |")
    return "\n".join(rows + [_predicted(r["chain"], r["bias"]) for r in records if "bias" in r]) + "\n"


def _predicted(chain: str, bias: dict) -> str:
    """The error of straight rays, measured and by least squares over the apparent rays."""
    off = 100.0 * (bias["measured_m"] / bias["same_views_m"] - 1.0)
    return (
        f"\nStraight rays, {chain}: {bias['measured_m']:+.3f} m over the bed at {bias['num_points']:,} points away "
        f"from objects; least squares over the apparent rays of the views that decide {bias['same_views_m']:+.3f} m "
        f"({off:+.1f} %), of all that see a point {bias['all_views_m']:+.3f} m."
    )


def _cell(mean: float, std: float, completeness: float) -> str:
    return f"{_spread(mean, std)}, {100 * completeness:.1f} %"


def _spread(mean: float, std: float) -> str:
    return f"{1e3 * mean:+.1f} +- {1e3 * std:.1f} mm"


def drawn(folder: Path) -> tuple[Path, Path, Path]:
    """A small wet survey, the same one dry, and their reference."""
    wet, dry = folder / "wet", folder / "dry"
    for place, options in ((wet, []), (dry, ["water=false"])):
        subprocess.run([sys.executable, "-m", "survey.simulate.drawn", str(place), *options], check=True)
    return wet, dry, wet / "truth" / "reference.ply"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--chains", nargs="+", choices=CHAINS, default=["sweep", "field"])
    parser.add_argument("--quality", default="draft")
    parser.add_argument("--samples", type=int, default=1_500_000, help="of the reference (the study: 15,000,000)")
    parser.add_argument("-o", "--output", type=Path)
    parser.add_argument("--device", default="auto", choices=("auto", "cpu", "cuda"))
    for name, default in (("steps", 2000), ("rays", 4096), ("cells", 256)):
        parser.add_argument(f"--{name}", type=int, default=default, help="of a model's training")
    options = parser.parse_args()
    # Models take poses and water from the sweep's runs.
    options.chains = sorted(options.chains, key=CHAINS.index)
    if options.chains[-1] in MODELS and options.chains[0] != "sweep":
        parser.error(f"--chains has {options.chains[-1]} but not sweep, whose poses and water it takes; add sweep")
    folder = options.output or Path(tempfile.mkdtemp(prefix="bathynerf_table4_"))
    folder.mkdir(parents=True, exist_ok=True)
    if options.full:
        wet, dry = DATA / "wreck_water", DATA / "wreck_dry"
        reference = wet / "reference.ply"
    else:
        wet, dry, reference = drawn(folder)
    truth, records = load_survey(wet), []
    for case in cases(wet, dry, folder, options.chains):
        (train if case.is_volume else process)(case, options)
        records.append(measure(case, truth, reference, options.samples, RECIPES[options.quality].times_seen))
        (folder / "table4.json").write_text(json.dumps(records, indent=2))
    print(table(records))  # noqa: T201


if __name__ == "__main__":
    main()
