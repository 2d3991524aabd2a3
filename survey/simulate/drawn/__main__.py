"""Draw a small survey into a folder, unless it is there already."""

from __future__ import annotations

import argparse
import tomllib
from pathlib import Path

from geo.errors import GeoError
from survey.errors import SurveyError
from survey.files.toml_table import parse_toml
from survey.progress import Progress
from survey.simulate.drawn import draw_survey
from survey.simulate.drawn.settings import DrawnScene


def main(arguments: list[str] | None = None) -> None:
    """``python -m survey.simulate.drawn``; what cannot be used, or written, ends it with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m survey.simulate.drawn", description=__doc__)
    parser.add_argument("folder", type=Path, help="survey folder to write, with the ground truth in truth/")
    parser.add_argument("--tiny", action="store_true", help="8 small views without noise, in about a second")
    parser.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="of DrawnScene, e.g. shore=true glint_share=0.1"
    )
    given = parser.parse_intermixed_args(arguments)
    text = "\n".join(given.settings)
    try:
        scene = parse_toml(text, DrawnScene)
        if given.tiny:
            scene = DrawnScene.tiny(**{name: getattr(scene, name) for name in tomllib.loads(text)})
        with Progress() as progress:
            draw_survey(given.folder, scene, progress=progress)
    except (GeoError, SurveyError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
