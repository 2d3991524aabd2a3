"""Options of `process` and `check` from variables of the environment, which stand between options and survey.toml."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import fields, replace

from survey.errors import ConfigError
from survey.files.toml_table import parse_values
from survey.settings.tables import ProcessConfig

PREFIX = "BATHYNERF_PROCESS_"


def asked_of_environment(environ: Mapping[str, str] = os.environ) -> ProcessConfig:
    """Settings by variables like BATHYNERF_PROCESS_QUALITY, each named like its key in [process] of survey.toml.

    Raises
    ------
    ConfigError
        At a variable that is no such key, or a value that is none of it.
    """
    names = {f"{PREFIX}{field.name.upper()}": field.name for field in fields(ProcessConfig)}
    given = {variable: text for variable, text in environ.items() if variable.startswith(PREFIX)}
    for variable in given.keys() - names.keys():
        raise ConfigError(f"unknown variable {variable} in the environment; known are {', '.join(names)}")
    asked = ProcessConfig()
    for variable, text in given.items():
        name = names[variable]
        try:
            asked = replace(asked, **{name: getattr(parse_values({name: _value(text)}, ProcessConfig), name)})
            asked.require_sane()
        except ConfigError as error:
            said = str(error).replace("[process] has", "it has").replace("[process] ", "").replace(name, variable, 1)
            raise ConfigError(f"in the environment: {said}") from error
    return asked


def _value(text: str) -> str | float | int | bool:
    """A text as TOML would have it; words stand without quotes."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError:
        return text
