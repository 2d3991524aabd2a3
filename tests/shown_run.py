"""A small run as the viewer has it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from small_bed import plane_bed
from small_survey import small_survey

from survey.folder.survey import load_survey
from survey.run.flight import Flight, save_flight
from survey.run.folder import RunDir
from survey.run.products import write_bed_las
from survey.run.stored import StoredBed, save_bed
from survey.viewer.page import Overlay, close_server, open_server
from survey.viewer.session import ViewSession
from survey.viewer.shown import Shown
from survey.viewer.tree import build_tree


def shown_of(folder: Path, num: int = 300) -> Shown:
    """The plane of `small_bed` over the small survey, ready to be shown."""
    survey = load_survey(small_survey(folder))
    bed = plane_bed(survey, num=num)
    columns = {"height": bed.xyz[:, 2], "std": bed.std, "depth": bed.depth}
    flight = Flight(survey.frame, survey.water, survey.views, None)
    return Shown(folder, "small", build_tree(bed.xyz), bed.rgb, columns, flight, True, 0.1)


@contextmanager
def served(shown: Shown) -> Iterator[ViewSession]:
    """A session on a server of its own."""
    overlay = Overlay()
    server = open_server("localhost", 0, "test", overlay)
    session = ViewSession(shown, server)
    overlay.attach(session)
    try:
        yield session
    finally:
        session.close()
        close_server(server)


def small_run(folder: Path) -> Path:
    """A finished run with cameras and a cloud, of the survey in ``folder / "s"``."""
    survey = load_survey(small_survey(folder / "s"))
    bed = plane_bed(survey, num=40)
    stored = StoredBed(bed, survey.frame.crs_from_local(bed.xyz), survey.frame.crs, "small", 0.1)
    with RunDir(folder / "run") as run:
        stage = run.open_stage("bed")
        save_bed(stage, stored)
        stage = run.finish_stage("bed", {}, stage)
        result = run.open_result("standard")
        save_flight(result, survey)
        write_bed_las(result / "cloud.las", stored)
        run.publish(result, quality="standard", stages={"bed": stage})
    return run.path
