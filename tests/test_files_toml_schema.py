"""The JSON schema of survey.toml: it takes what the reader takes, and refuses what it refuses by kind."""

import json
import tomllib
from pathlib import Path

import pytest
from command_line import bathynerf
from small_survey import unposed
from test_settings_config import FULL

from survey.errors import ConfigError
from survey.files.toml_table import schema_of
from survey.init.draft import SCHEMA_LINE, SCHEMA_NAME
from survey.settings.config import SurveyConfig, parse_config

SCHEMA = json.loads(json.dumps(schema_of(SurveyConfig)))
TYPES = {"number": (int, float), "integer": int, "string": str, "boolean": bool, "array": list, "object": dict}
EXAMPLE = (Path(__file__).resolve().parent.parent / "docs" / "survey-toml.md").read_text().split("```toml\n")[1]


def is_valid(value, schema) -> bool:
    """What a validator of draft 7 says, of the words that are used here."""
    if "anyOf" in schema:
        return any(is_valid(value, one) for one in schema["anyOf"])
    if "enum" in schema:
        return value in schema["enum"]
    if not isinstance(value, TYPES[schema["type"]]) or (isinstance(value, bool) and schema["type"] != "boolean"):
        return False
    if schema["type"] == "array":
        least, most = schema.get("minItems", 0), schema.get("maxItems", len(value))
        return least <= len(value) <= most and all(is_valid(item, schema["items"]) for item in value)
    if schema["type"] == "object":
        assert schema["additionalProperties"] is False
        known = schema["properties"]
        return all(name in known and is_valid(item, known[name]) for name, item in value.items())
    return True


@pytest.mark.parametrize("text", [FULL, "", EXAMPLE.partition("```")[0]])
def test_what_is_read_fits_the_schema(text):
    parse_config(text)
    assert is_valid(tomllib.loads(text), SCHEMA)


@pytest.mark.parametrize(
    "text",
    [
        "nme = 'x'",
        "name = 1",
        "[water]\nlevel_m = 'high'",
        "[water]\nlevel = 1.0",
        "[cameras]\nsize_px = [10]",
        "[cameras]\nsize_px = [10.5, 20]",
        "[cameras]\nfocal_px = [1, 2, 3]",
        "[cameras]\ngps_height = 'geoid'",
        "[area]\nbounds = [1, 2, 3]",
        "[control]\ngcps = 1",
        "[process]\nquality = 'best'",
        "[process]\nimage_scale = 0.3",
        "[process]\ntrue_colour = 1",
        "area = 1",
    ],
)
def test_what_is_refused_by_its_kind_fits_it_not(text):
    with pytest.raises(ConfigError):
        parse_config(text)
    assert not is_valid(tomllib.loads(text), SCHEMA)


def test_every_key_with_wording_of_its_own_is_described():
    assert "[width, height]" in SCHEMA["properties"]["cameras"]["properties"]["size_px"]["description"]
    assert SCHEMA["properties"]["water"]["description"].startswith("[water]: a plane")
    assert SCHEMA["properties"]["images"]["properties"]["dir"]["default"] == "images"


def test_init_writes_the_schema_and_names_it(tmp_path):
    folder = unposed(tmp_path / "s")
    text = (folder / "survey.toml").read_text()
    kept = bathynerf("init", folder, "--schema")
    assert (kept.exit_code, (folder / "survey.toml").read_text()) == (0, text)
    assert json.loads((folder / SCHEMA_NAME).read_text()) == SCHEMA
    assert SCHEMA_LINE.strip() in kept.stderr
    (folder / "survey.toml").unlink()
    assert bathynerf("init", folder, "--schema", "--level", "2105").exit_code == 0
    assert (folder / "survey.toml").read_text().startswith(SCHEMA_LINE)
    assert bathynerf("check", folder).exit_code == 0
    assert bathynerf("init", tmp_path / "none", "--schema").exit_code == 2
