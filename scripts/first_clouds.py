"""Try the first cloud as a stranger would, in a bare system, and write the transcripts into docs/first-cloud.md.

    debootstrap --variant=minbase --include=python3,python3-venv,libatomic1,libllvm19,ca-certificates bookworm ROOT
    python -m pip wheel --no-deps -w dist .
    python examples/exports.py SURVEYS
    sudo .venv/bin/python scripts/first_clouds.py ROOT dist/bathynerf-*.whl SURVEYS [--find-links WHEELS]

ROOT is a folder with a system in it, as a container has one, and from it nothing outside is seen: the commands run
there in namespaces of their own (unshare), as a user without rights, with a home that holds nothing, no environment
but HOME, PATH and LANG, and no compiler. The wheel is installed from its file with constraints.txt, in an environment
of its own; --find-links copies a folder of wheels there first, for the CPU build of torch. Then each survey of
examples/exports.py takes the three commands.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

HERE = Path(__file__).resolve().parent.parent
PAGE = HERE / "docs" / "first-cloud.md"
HOME, USER = "/home/you", 1000
LEVEL = "584.2"
# The true bed less 30 cm at its edge.
BOUNDS = "676115.3 5311475.8 676124.7 5311484.2"
# The first is shown, all are compared with the true bed.
SURVEYS = ("photographs", "metashape", "odm", "colmap")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("surveys", type=Path)
    parser.add_argument("--find-links", type=Path)
    given = parser.parse_args()
    home = given.root / HOME.lstrip("/")
    furnish(home, given.surveys, given.wheel, given.find_links)
    parts = [install(given.root, given.wheel.name, given.find_links is not None)]
    shown, *_ = [try_survey(given.root, name) for name in SURVEYS]
    parts += [shown, compared(given.root)]
    PAGE.write_text(page(parts), encoding="utf-8")


def furnish(home: Path, surveys: Path, wheel: Path, wheels: Path | None) -> None:
    """Put the surveys, the wheel and the constraints into an empty home."""
    shutil.rmtree(home, ignore_errors=True)
    home.mkdir(parents=True)
    for name in (*SURVEYS, "truth"):
        shutil.copytree(surveys / name, home / name)
    shutil.copy(wheel, home)
    shutil.copy(HERE / "constraints.txt", home)
    if wheels is not None:
        shutil.copytree(wheels, home / "wheels")
    subprocess.run(["chown", "-R", f"{USER}:{USER}", home], check=True)


def run(root: Path, command: str) -> str:
    """Output of a command in the system at ``root``, both streams as they come; it has to end with 0."""
    environment = ["env", "-i", f"HOME={HOME}", "PATH=" + HOME + "/bathynerf/bin:/usr/bin:/bin", "LANG=C.UTF-8"]
    apart = ["unshare", "--mount", "--pid", "--fork", f"--root={root}", "--mount-proc"]
    apart += [f"--setuid={USER}", f"--setgid={USER}", f"--wd={HOME}"]
    done = subprocess.run(
        [*apart, *environment, "sh", "-c", command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    sys.stderr.write(f"$ {command}\n{done.stdout}\n")
    if done.returncode:
        raise SystemExit(f"{shlex.quote(command)} ended with {done.returncode} in {root}")
    return done.stdout


def install(root: Path, wheel: str, has_wheels: bool) -> str:
    links = " --find-links wheels" if has_wheels else ""
    run(root, "python3 -m venv bathynerf")
    run(root, f"bathynerf/bin/pip install -q -c constraints.txt{links} ./{wheel} 2>&1")
    version = run(root, "python3 --version").strip()
    return (
        f"    $ python3 -m venv bathynerf && . bathynerf/bin/activate    # {version}\n"
        f"    $ pip install -q -c constraints.txt {wheel}\n"
    )


def try_survey(root: Path, name: str) -> str:
    """The section of a survey: its command with what it prints."""
    command = f"bathynerf process {name} --level {LEVEL} --quality draft"
    return (
        "## From photographs alone\n\nPhotographs of a drone with RTK positions, and nothing else.\n\n"
        f"    $ {command}\n{indented(transcript(run(root, command)))}"
    )


def compared(root: Path) -> str:
    """Each cloud against the true bed: mean and standard deviation of wet and of dry ground."""
    shown = ["## Against the true bed\n"]
    rows = ["| | wet: mean | std | dry: mean | std |", "|---|---|---|---|---|"]
    for name in SURVEYS:
        command = f"bathynerf compare -q {name}/bathynerf/cloud.las truth/reference.ply --bounds {BOUNDS}"
        lines = [line for line in run(root, command).splitlines() if line.startswith(("wet", "dry"))]
        if len(rows) == 2:
            shown.append("    $ " + command.replace(" --bounds", " \\\n        --bounds") + "\n")
        rows.append(f"| {name} | " + " | ".join(millimetres(line) for line in sorted(lines, reverse=True)) + " |")
    return "\n".join([*shown, *rows]) + "\n"


def millimetres(line: str) -> str:
    """Mean and standard deviation of a row of compare, as two cells of a table."""
    _, _, mean, _, std, *_ = re.split(r"\s{2,}", line)
    return f"{mean} mm | {std} mm"


def transcript(text: str) -> list[str]:
    """The lines of a transcript without times of the day."""
    return [re.sub(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d ", "", line.rstrip()) for line in text.splitlines()]


def indented(lines: list[str]) -> str:
    out = []
    for line in lines:
        indent = re.match(r" *", line).group() + "    "
        out += textwrap.wrap(line.strip(), 116, initial_indent=indent, subsequent_indent=indent + "    ") or [""]
    return "\n".join(out).rstrip() + "\n"


def page(parts: list[str]) -> str:
    head = (
        "# The first cloud, in one command\n\n"
        "`process` writes survey.toml from what a folder holds, with a comment at everything that it assumed, and "
        "computes the\ncloud. The output below is of a simulated survey of 18 photographs of 480 x 360 px "
        "(`examples/exports.py`);\n`scripts/first_clouds.py` repeats it in a bare Debian with Python alone, without "
        "root. The water stands at 584.2 m,\nwhich no file states: `--level`; on a terminal it is asked for. Poses of "
        "[Metashape](from-metashape.md),\n[OpenDroneMap](from-odm.md) and [COLMAP](from-colmap.md) take the same "
        "command.\n"
    )
    return "\n".join([head, *parts]).rstrip() + "\n"


if __name__ == "__main__":
    main()
