"""Inputs beyond all measure are refused in a short sentence, before they take time or memory."""

import pytest
from command_line import bathynerf
from shown_run import small_run
from small_survey import E0, LEVEL, N0, TOML, small_survey

from survey.commands.faults import BAD_INPUT
from survey.control import reading
from survey.files import toml_table

CONTROL = TOML + '[control]\ngcps = "gcp_list.txt"\n'
MARK = f"{E0} {N0} {LEVEL - 1.0} 10 10 0000.jpg p\n"
DEEP = 100_000
NESTED = {"lists": "[" * DEEP + "]" * DEEP, "objects": '{"a":' * DEEP + "1" + "}" * DEEP}


def refused(*arguments) -> str:
    said = bathynerf(*arguments)
    assert said.exit_code == BAD_INPUT, said.output
    assert "bug" not in said.stderr
    assert len(said.stderr) < 10_000
    return said.stderr


@pytest.mark.parametrize(("file", "content"), [("gcp_list.txt", f"EPSG:25832\n{MARK}"), ("survey.toml", "a = 1\n")])
def test_a_text_that_is_too_large_is_refused(tmp_path, file, content):
    folder = small_survey(tmp_path / "s", toml=CONTROL)
    most = {"gcp_list.txt": reading._MOST_BYTES, "survey.toml": toml_table._MOST_BYTES}[file]
    (folder / file).write_text(content * (most // len(content) + 1))
    assert "MB, expected" in refused("check", folder)


@pytest.mark.parametrize("line", ["a" * 900_000 + " = 1", f'dry = "{"a" * 900_000}"', f'crs = "{"E" * 900_000}"'])
def test_of_a_long_key_or_value_start_and_end_are_shown(tmp_path, line):
    assert "..." in refused("check", small_survey(tmp_path / "s", toml=f"{line}\n"))


@pytest.mark.parametrize("option", ["tiles", "workers"])
@pytest.mark.parametrize("number", [10**5, 10**9, 10**18])
def test_numbers_of_tiles_and_processes_have_limits(tmp_path, option, number):
    folder = small_survey(tmp_path / "s")
    assert f"--{option} is {number}, expected a number of at least 1 and at most 1" in refused(
        "process", folder, f"--{option}", number
    )


@pytest.mark.parametrize("nested", NESTED)
@pytest.mark.parametrize("key", ["poses", "gcps", "surface"])
def test_deeply_nested_json_is_refused(tmp_path, nested, key):
    name = {"poses": "reconstruction.json", "gcps": "gcp.json", "surface": "w.geojson"}[key]
    toml = {
        "poses": TOML.replace("cameras.csv", name),
        "gcps": f'{TOML}[control]\ngcps = "{name}"\n',
        "surface": TOML.replace(f"level_m = {LEVEL}", f'surface = "{name}"'),
    }[key]
    folder = small_survey(tmp_path / "s", toml=toml)
    (folder / name).write_text(NESTED[nested])
    refused("check", folder)


@pytest.mark.parametrize(
    "content", [NESTED["objects"], "", "[1]", "\0" * 99, "{"], ids=["deep", "", "list", "nul", "cut"]
)
def test_a_run_whose_files_are_damaged_is_refused(tmp_path, content):
    run = small_run(tmp_path)
    for path in sorted(path for path in run.rglob("*") if path.is_file()):
        before = path.read_bytes()
        path.write_text(content)
        for options in (("export", "--cameras", "c.json"), ("view", "--export", "v.html")):
            said = bathynerf(options[0], run, options[1], tmp_path / options[2])
            assert said.exit_code in (0, BAD_INPUT), path
            assert "bug" not in said.stderr
            (tmp_path / options[2]).unlink(missing_ok=True)
        path.write_bytes(before)
