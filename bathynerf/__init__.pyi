from geo.errors import GeoError
from geo.frames import LocalFrame
from geo.las import read_cloud, write_cloud
from geo.reading import read_reference
from geo.shapes import Cloud, Mesh
from refract.camera import PinholeCamera
from refract.curved.surfaces import BicubicWater, WavyWater
from refract.distortion import Distortion
from refract.media import water_index
from refract.paths import project, trace
from refract.surfaces import FlatWater, WaterSurface
from survey.adjust.waterline import estimate_water
from survey.change.change import change_between as change
from survey.change.series import change_series
from survey.compare.comparison import compare_files as compare
from survey.compare.options import ChangeOptions, CompareOptions
from survey.errors import SurveyError
from survey.export.export import export
from survey.export.profiles import Profile, profiles_along
from survey.export.registry import ExportOptions
from survey.export.render import render
from survey.folder.survey import Survey as LoadedSurvey
from survey.folder.survey import load_survey
from survey.handles.field import Field, train_field
from survey.handles.run import Dem, Run, Survey
from survey.init.draft import write_settings as init
from survey.photos.cameras import View
from survey.plan.choices import Choices
from survey.plan.plan import Plan, make_plan
from survey.progress import Progress
from survey.run.edits import Edits as edit
from survey.run.process import process
from survey.settings.tables import InitOptions
from survey.simulate.drawn import DrawnScene, draw_survey
from survey.simulate.simulate import simulate

__version__: str

__all__ = [
    "BicubicWater",
    "ChangeOptions",
    "Choices",
    "Cloud",
    "CompareOptions",
    "Dem",
    "Distortion",
    "DrawnScene",
    "ExportOptions",
    "Field",
    "FlatWater",
    "GeoError",
    "InitOptions",
    "LoadedSurvey",
    "LocalFrame",
    "Mesh",
    "PinholeCamera",
    "Plan",
    "Profile",
    "Progress",
    "Run",
    "Survey",
    "SurveyError",
    "View",
    "WaterSurface",
    "WavyWater",
    "__version__",
    "change",
    "change_series",
    "compare",
    "draw_survey",
    "edit",
    "estimate_water",
    "export",
    "init",
    "load_survey",
    "make_plan",
    "process",
    "profiles_along",
    "project",
    "read_cloud",
    "read_reference",
    "render",
    "simulate",
    "trace",
    "train_field",
    "water_index",
    "write_cloud",
]
