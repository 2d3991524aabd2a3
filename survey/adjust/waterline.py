"""The water of a survey from its photographs, for `bathynerf waterline`: values, standard deviations and verdicts."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from geo.files import write_text
from survey.adjust.block.bundle import NotConvergedError
from survey.adjust.block.normal_matrix import propagated
from survey.adjust.block.state import NUM_WATER, WATER_PARAMETERS, settings_by_local, settings_of
from survey.adjust.observability import none_observable
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment, Parameter, unobservable_verdict
from survey.errors import SurveyError
from survey.files.json_values import json_text
from survey.files.paths import is_json, require_file
from survey.folder.found import survey_inputs
from survey.folder.local_frame import water_plane
from survey.folder.survey import Survey, load_survey
from survey.machine import require_memory
from survey.progress import current
from survey.settings.config import WaterConfig
from survey.words import SFM_FOLDER


@dataclass(frozen=True)
class WaterEstimate:
    water: WaterConfig  # Values to use: estimates of the observable parameters, those of survey.toml for the rest
    parameters: tuple[Parameter, ...]  # Level, slopes and index first, then those of the lenses
    covariance: np.ndarray  # (4, 4): of level, slopes and index
    num_views: int
    num_points: int
    num_measurements: int
    num_dry: int  # Points above the water, which tell nothing of it
    rms_px: float | None  # [px]: of the residuals of a pixel coordinate; None where there was no adjustment
    warnings: tuple[str, ...] = ()  # sentences: of the adjustment

    @property
    def estimates(self) -> tuple[Parameter, ...]:
        """Level, slopes and index."""
        return self.parameters[: len(WATER_PARAMETERS)]

    @property
    def is_observable(self) -> bool:
        """Whether anything is observable: without the level, nothing is."""
        return self.estimates[0].is_observable

    def correlation(self) -> np.ndarray:
        """Correlations (4, 4) of the estimates."""
        std = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(std, std)

    def to_json(self) -> str:
        """All of it as JSON; units are in the names, and NaN is null."""
        rows = [{**asdict(row), "is_observable": row.is_observable} for row in self.parameters]
        known = {**asdict(self), "correlation": self.correlation()}
        return json_text({**known, "estimates": rows[: len(WATER_PARAMETERS)], "parameters": rows})


def estimate_water(
    folder: str | Path,
    *,
    device: str = "auto",
    run_folder: str | Path | None = None,
    json_path: str | Path | None = None,
) -> WaterEstimate:
    """The water of a survey folder, estimated from its photographs; no setting and no result of a run changes.

    Raises SurveyError or GeoError where the survey cannot be used, its photographs do not match, or the file cannot be
    written.

    Parameters
    ----------
    run_folder : Path, optional
        Whose poses by structure from motion are used, for a survey that comes without poses; default
        ``folder/bathynerf``. Where it has none of these photographs they are solved for, and kept there.
    json_path : Path, optional
        Gets everything that was found.
    """
    progress, folder = current(), Path(folder)
    run_folder = None if run_folder is None else Path(run_folder)
    json_path = None if json_path is None else Path(json_path)
    workspace = None if run_folder is None else run_folder / SFM_FOLDER
    if workspace is not None and not workspace.is_dir():
        raise SurveyError(
            f"{run_folder} has no poses by structure from motion (there is no folder {workspace}); name a run folder "
            "of this survey that has, or leave --run out"
        )
    if json_path is not None:
        require_file("--json", json_path, survey_inputs(folder), kind="a JSON file", is_of_kind=is_json)
    require_memory()
    survey = load_survey(folder, workspace=workspace, report=progress.note)
    survey.require_water()
    with progress.stage("Water", 1.0) as stage:
        found = calibrate_water(survey, device=device, advance=stage.advance)
    for text in found.warnings:
        progress.warn(text)
    if json_path is not None:
        write_text(json_path, found.to_json())
    return found


def calibrate_water(
    survey: Survey, *, device: str = "auto", advance: Callable[[float], None] = lambda _share: None
) -> WaterEstimate:
    """Estimate the water of a survey from its photographs.

    Where the adjustment does not converge nothing is observable, and the verdict on the level says why. The water of
    the survey is where the search starts; half a metre off is near enough.
    """
    survey.require_water()
    try:
        found = adjust_survey(survey, device=device, advance=advance, free_water=True)
    except NotConvergedError as error:
        return _not_adjusted(survey, str(error))
    assert found.water is not None
    return WaterEstimate(
        water=found.water,
        parameters=found.parameters,
        covariance=_covariance(survey, found),
        num_views=len(np.unique(found.residuals.view)),
        num_points=found.statistics.num_points,
        num_measurements=len(found.residuals.view),
        num_dry=int((water_plane(survey.frame, found.water).depth(found.points) <= 0.0).sum()),
        rms_px=float(np.sqrt(np.mean(np.square(found.residuals.px)))),
        warnings=found.warnings,
    )


def _covariance(survey: Survey, found: Adjustment) -> np.ndarray:
    if not found.parameters[0].is_observable:
        # The block was adjusted under the given water.
        return np.diag([row.std**2 for row in found.parameters[:NUM_WATER]])
    by_local = settings_by_local(survey, np.array(found.covariance.water_point))
    return propagated(by_local, found.covariance.matrix[:NUM_WATER, :NUM_WATER])


def _not_adjusted(survey: Survey, reason: str) -> WaterEstimate:
    """The estimate where nothing was adjusted."""
    _, given = survey.require_water()
    rows = zip(none_observable(reason).items(), settings_of(given).tolist(), strict=True)
    parameters = tuple(unobservable_verdict(name, lost.std, value, lost.reason) for (name, lost), value in rows)
    covariance = np.diag([row.std**2 for row in parameters])
    return WaterEstimate(given, parameters, covariance, 0, 0, 0, 0, None)
