"""The Python interface of bathynerf: the commands and their building blocks under one name.

>>> from bathynerf import LocalFrame, Run, Survey, compare, process, simulate

Everything is defined in the packages `survey`, `refract`, `geo`, `fields` and `evaluation`, and imported from there
when it is first used, so that ``import bathynerf`` itself is quick. docs/python.md has examples.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from bathynerf._packages import find_beside, require_packages

if TYPE_CHECKING:
    from geo.errors import GeoError
    from geo.frames import LocalFrame
    from geo.las import read_cloud, write_cloud
    from geo.reading import read_reference
    from geo.shapes import Cloud, Mesh
    from refract.camera import PinholeCamera
    from refract.curved.bicubic import BicubicWater
    from refract.curved.wavy import WavyWater
    from refract.distortion import Distortion
    from refract.media import water_index
    from refract.paths import trace
    from refract.projection import project
    from refract.surfaces import FlatWater, WaterSurface
    from survey.adjust.waterline import estimate_water
    from survey.compare.comparison import compare_files as compare
    from survey.compare.options import CompareOptions
    from survey.errors import SurveyError
    from survey.export.export import export
    from survey.export.product import ExportOptions
    from survey.export.profiles import Profile, profiles_along
    from survey.export.render import render
    from survey.folder.survey import Survey as LoadedSurvey
    from survey.folder.survey import load_survey
    from survey.handles.run import Dem, Run
    from survey.handles.survey import Survey
    from survey.photos.cameras import View
    from survey.plan.choices import Choices
    from survey.plan.plan import Plan, make_plan
    from survey.progress import Progress
    from survey.run.process import process
    from survey.simulate.drawn import draw_survey
    from survey.simulate.drawn.settings import DrawnScene
    from survey.simulate.staging.simulate import simulate

    __version__: str

__all__ = [
    "BicubicWater",
    "Choices",
    "Cloud",
    "CompareOptions",
    "Dem",
    "Distortion",
    "DrawnScene",
    "ExportOptions",
    "FlatWater",
    "GeoError",
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
    "compare",
    "draw_survey",
    "estimate_water",
    "export",
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
    "water_index",
    "write_cloud",
]

# Where each name is defined; editors and type checkers read the same from the imports above.
_MODULES = {
    "geo.errors": ("GeoError",),
    "geo.frames": ("LocalFrame",),
    "geo.las": ("read_cloud", "write_cloud"),
    "geo.reading": ("read_reference",),
    "geo.shapes": ("Cloud", "Mesh"),
    "refract.camera": ("PinholeCamera",),
    "refract.distortion": ("Distortion",),
    "refract.curved.bicubic": ("BicubicWater",),
    "refract.media": ("water_index",),
    "refract.paths": ("trace",),
    "refract.projection": ("project",),
    "refract.surfaces": ("FlatWater", "WaterSurface"),
    "refract.curved.wavy": ("WavyWater",),
    "survey.adjust.waterline": ("estimate_water",),
    "survey.compare.comparison": ("compare",),
    "survey.compare.options": ("CompareOptions",),
    "survey.errors": ("SurveyError",),
    "survey.export.export": ("export",),
    "survey.export.product": ("ExportOptions",),
    "survey.folder.survey": ("LoadedSurvey", "load_survey"),
    "survey.handles.run": ("Dem", "Run"),
    "survey.handles.survey": ("Survey",),
    "survey.photos.cameras": ("View",),
    "survey.plan.choices": ("Choices",),
    "survey.plan.plan": ("Plan", "make_plan"),
    "survey.export.profiles": ("Profile", "profiles_along"),
    "survey.progress": ("Progress",),
    "survey.run.process": ("process",),
    "survey.export.render": ("render",),
    "survey.simulate.drawn": ("draw_survey",),
    "survey.simulate.drawn.settings": ("DrawnScene",),
    "survey.simulate.staging.simulate": ("simulate",),
}
find_beside()

_OTHER_NAMES = {"compare": "compare_files", "LoadedSurvey": "Survey"}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


# Type checkers see the imports above alone, so that they find a name that does not exist.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """A name at its first use, from where it is defined."""
        if name == "__version__":
            from importlib.metadata import version

            value: Any = version("bathynerf")
        elif name in _HOME:
            require_packages()
            value = getattr(importlib.import_module(_HOME[name]), _OTHER_NAMES.get(name, name))
        else:
            raise AttributeError(f"module 'bathynerf' has no attribute {name!r}")
        globals()[name] = value
        return value


def __dir__() -> list[str]:
    return sorted(__all__)
