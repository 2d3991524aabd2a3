"""Draw a small survey into a folder, unless it is there already."""

from __future__ import annotations

import argparse
from pathlib import Path

from geo.errors import GeoError
from survey.errors import SurveyError
from survey.progress import Progress
from survey.simulate.drawn import draw_survey
from survey.simulate.drawn.settings import DrawnScene

# Speed [m/s] and readout time [s] with --rolling.
_SPEED_M_S, _READOUT_S = 5.0, 0.03


def main(arguments: list[str] | None = None) -> None:
    """``python -m survey.simulate.drawn``; a folder that cannot be used, or written, ends it with exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m survey.simulate.drawn", description=__doc__)
    parser.add_argument("folder", type=Path, help="survey folder to write, with the ground truth in truth/")
    parser.add_argument("--tiny", action="store_true", help="8 small views without noise, in about a second")
    parser.add_argument("--shore", action="store_true", help="add a bank that rises out of the water")
    parser.add_argument("--dry", action="store_true", help="the same bed without water")
    parser.add_argument("--rolling", action="store_true", help="flown at 5 m/s, with a shutter that rolls in 30 ms")
    parser.add_argument(
        "--glint", type=float, default=0.0, metavar="SHARE", help="share of pixels saturated by the sun"
    )
    parser.add_argument(
        "--caustics", type=float, default=0.0, metavar="CONTRAST", help="contrast of sunlight on the bed"
    )
    parser.add_argument("--temperature", type=float, metavar="DEG_C", help="temperature of water with dispersion")
    parser.add_argument("--rise", type=float, default=0.0, metavar="M", help="rise of the water during the flight")
    parser.add_argument("--seed", type=int, default=1, help="another bed and flight (default: 1)")
    parser.add_argument("--again", action="store_true", help="draw even if the same survey exists")
    given = parser.parse_args(arguments)
    make = DrawnScene.tiny if given.tiny else DrawnScene
    try:
        with Progress() as progress:
            speed, readout = (_SPEED_M_S, _READOUT_S) if given.rolling else (0.0, 0.0)
            scene = make(
                shore=given.shore,
                water=not given.dry,
                seed=given.seed,
                speed_m_s=speed,
                readout_s=readout,
                glint_share=given.glint,
                caustic_contrast=given.caustics,
                temperature_c=given.temperature,
                rise_m=given.rise,
            )
            draw_survey(given.folder, scene, again=given.again, progress=progress)
    except (GeoError, SurveyError, OSError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
