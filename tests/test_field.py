"""`bathynerf field`: a published field on a run with a known bed; it goes on, and says what it cannot use."""

import json
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from command_line import bathynerf
from level_field import NAME
from painted_survey import painted_survey, run_over
from PIL import Image
from scipy.spatial.transform import Rotation

import fields.volume.train as train_module
from fields.device import choose_device
from fields.models import MODELS, Losses, Rule
from fields.volume.model import Setup, build_model
from fields.volume.paths import Box
from geo import read_cloud
from refract import PinholeCamera
from survey.errors import ConfigError, OutputError, SurveyError
from survey.export.loaded import LoadedRun
from survey.files.paths import ReadFiles
from survey.run.folder import Owner, RunDir
from survey.run.products import write_bed_ply
from survey.settings.config import parse_config
from survey.settings.tables import FieldConfig
from survey.volume import scene
from survey.volume.field import train_field
from survey.volume.options import MONOCULAR, VolumeOptions, field_config, monocular_priors, volume_options
from survey.volume.scene import VolumeFolder

SHORT = VolumeOptions(model=NAME, steps=4, rays=32, samples=8, cells=32, held_every=4, image_scale=0.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("field")


@pytest.fixture(scope="module")
def run(folder):
    return run_over(painted_survey(folder / "s"), folder / "run")


@pytest.mark.parametrize("name", list(MODELS))
def test_every_model_is_built_for_a_box_and_another_seed_draws_another_one(name):
    setup = Setup(Box(np.zeros(3), np.array([2.0, 1.0, 0.5])), 16, choose_device("torch"), appearance=4, steps=60)
    x, direction = torch.rand(5, 3), torch.nn.functional.normalize(torch.ones(5, 3))
    outputs = []
    for seed in (0, 0, 1):
        model = build_model(name, setup, seed=seed)
        density, features = model.evaluate(x)
        assert density.shape == (5,)
        assert model.radiance(features, direction, torch.zeros(5, 4)).shape == (5, 3)
        proposal = model.proposal(setup)
        assert (proposal is None) == (name not in ("hash", "nerfacto"))
        outputs.append(dict(model.named_parameters()))
    one, same, other = outputs
    for key, value in one.items():
        assert torch.equal(value, same[key])
        if value.unique().numel() > 1:
            assert not torch.equal(value, other[key]), key


def test_a_field_is_trained_extracted_rendered_and_compared(folder, run):
    table = folder / "one.csv"
    table.write_text("\n".join((folder / "s" / "cameras.csv").read_text().splitlines()[:2]) + "\n")
    options = replace(SHORT, cameras=table, reference=run_cloud(run, folder))
    report = train_field(run, folder / "f", options)
    cloud = read_cloud(folder / "f" / "cloud.las")
    assert report["points"] == len(cloud.points) > 100
    assert report["photographs"] == 3
    assert len(report["held_out_psnr_db"]) == len(report["held_out_ssim"]) == 1
    training = report["training"]
    assert [step for step, *_ in training["history"]] == [1, 2, 3, 4]
    assert all(abs(db) < 60.0 for _, *both in training["history"] for db in both)
    assert min(report["cost"].values()) > 0.0
    assert report["cost"]["rays_per_s"] == pytest.approx(4 * 32 / report["cost"]["wall_s"])
    with Image.open(folder / "f" / "training.png") as picture:
        assert min(picture.size) > 300
    # The bed slopes by a tenth over 8 m.
    over = report["over_the_bed_of_the_run_m"]
    assert abs(over["median_m"]) < 0.3
    assert over["std_m"] < 0.5
    assert report["compared"]["n_points"] > 100
    assert json.loads((folder / "f" / "report.json").read_text())["model"] == NAME
    assert len(list((folder / "f" / "views").glob("000?.png"))) == 1
    with Image.open(folder / "f" / "held out" / "0000.png") as picture:
        assert picture.mode == "RGBA"


def test_a_field_without_a_surface_is_reported_and_not_compared(folder, run):
    table = folder / "of nothing.csv"
    table.write_text("\n".join((folder / "s" / "cameras.csv").read_text().splitlines()[:2]) + "\n")
    nothing = replace(SHORT, rule=Rule.density, density=1e9, reference=run_cloud(run, folder), cameras=table)
    report = train_field(run, folder / "nothing", nothing)
    assert json.loads((folder / "nothing" / "report.json").read_text())["points"] == report["points"] == 0
    assert "compared" not in report
    assert list((folder / "nothing" / "views").glob("000?.png"))
    found = bathynerf(
        "field", run, "-o", folder / "no word", "--model", NAME, "--steps", 1, "--rays", 32, "--samples", 8,
        "--cells", 16, "--image-scale", 0.5, "--extract", "density", "--density", 1e9,
    )  # fmt: skip
    assert found.exit_code == 0, found.stderr
    assert "the surface has no points: nothing that two photographs see is opaque after 1 steps" in found.output


def test_held_out_photographs_are_predicted_in_their_own_exposure(tmp_path):
    """Fitted on the left half, scored on the right one; one of those that are held out is dark."""
    run = run_over(painted_survey(tmp_path / "s", exposures=(1.0, 1.0, 0.1, 1.0)), tmp_path / "run")
    options = replace(SHORT, steps=30, rays=256, held_every=2)
    plain, fitted = (
        train_field(run, tmp_path / f"f{look}", replace(options, appearance=look))["held_out_psnr_db"]
        for look in (False, True)
    )
    # The first and every second one, as nerfstudio counts.
    assert fitted.keys() == plain.keys() == {"0000.png", "0002.png"}
    assert fitted["0002.png"] > plain["0002.png"] + 3.0


def run_cloud(run, folder):
    """The bed of the run as a PLY."""
    path = folder / "bed.ply"
    with LoadedRun(run) as loaded:
        write_bed_ply(path, loaded.bed)
    return path


def test_the_same_training_again_computes_no_step(folder, run):
    train_field(run, folder / "g", SHORT)
    before = torch.load(folder / "g" / "state.pt", weights_only=True)
    again = train_field(run, folder / "g", SHORT)
    assert again["cost"]["cpu_s"] > before["cpu_s"] > 0.0
    after = torch.load(folder / "g" / "state.pt", weights_only=True)
    assert again["training"]["steps"] == after["step"] == 4
    torch.testing.assert_close(before["renderer"], after["renderer"], rtol=0.0, atol=0.0)
    assert "rays_per_s" not in again["cost"]
    with pytest.raises(OutputError, match=r"a volume of other settings \(steps: 4 there, 3 asked for\); name another"):
        train_field(run, folder / "g", replace(SHORT, steps=3))
    # A folder of an earlier version, which held out others.
    path = folder / "g" / "settings.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "held_out"}))
    with pytest.raises(OutputError, match=r"held_out: None there, photographs 0, 4, 8, \.\.\. asked for"):
        train_field(run, folder / "g", SHORT)


def test_moments_are_written_for_tensorboard_where_it_is_installed(folder, run):
    events = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator", reason="no tensorboard")
    history = train_field(run, folder / "events", SHORT)["training"]["history"]
    found = events.EventAccumulator(str(folder / "events")).Reload()
    for number, name in enumerate(("photographs", "held out"), 1):
        written = [(each.step, each.value) for each in found.Scalars(f"PSNR [dB]/{name}")]
        assert written == [(moment[0], pytest.approx(moment[number])) for moment in history]


def test_a_tensorboard_that_cannot_write_is_said_and_left_out(tmp_path, monkeypatch, caplog):
    def refuse(*_arguments, **_options):
        raise TypeError("descriptors cannot be created")

    monkeypatch.setattr(scene, "find_spec", lambda _name: True)
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", SimpleNamespace(SummaryWriter=refuse))
    volume = VolumeFolder(tmp_path / "f", {}, ReadFiles())
    for _ in range(2):
        volume.save(lambda: {"history": [(1, 20.0, None)]}, last=True)
    assert caplog.text.count("TensorBoard gets no curve of the training: descriptors cannot be created") == 1


def test_photographs_held_out_that_do_not_show_the_box_are_none(folder, run):
    with pytest.raises(SurveyError, match=r"none of the photographs 0, 4, 8, \.\.\. shows the box"):
        train_field(run, folder / "beside", replace(SHORT, bounds=(589019.0, 5194727.0, 589024.0, 5194732.0)))


def test_what_fewer_steps_made_is_gone_once_there_is_a_state_of_more(folder, run, monkeypatch):
    train_field(run, folder / "more", SHORT)
    made = [folder / "more" / name for name in ("cloud.las", "bed", "report.json", "held out")]
    views = folder / "more" / "views"
    views.mkdir()

    def stop(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr(scene, "_EVERY_S", -1.0)  # A state before every step
    for function, is_there in ((train_module.adam, True), (train_module._step, False)):
        with monkeypatch.context() as patch:
            patch.setattr(train_module, function.__name__, stop)
            with pytest.raises(KeyboardInterrupt):
                train_field(run, folder / "more", replace(SHORT, steps=6))
        settings = json.loads((folder / "more" / "settings.json").read_text())
        assert settings["steps"] == (4 if is_there else 6)
        assert [path.exists() for path in (*made, views)] == [is_there] * 5
    assert train_field(run, folder / "more", replace(SHORT, steps=6))["training"]["steps"] == 6
    assert all(path.exists() for path in made)


def test_a_field_that_is_trained_gets_more_steps(folder, run):
    before = train_field(run, folder / "longer", SHORT)["training"]
    after = train_field(run, folder / "longer", replace(SHORT, steps=6))["training"]
    assert after["history"] == [*before["history"], *after["history"][4:]]
    assert [step for step, *_ in after["history"]] == [1, 2, 3, 4, 5, 6]
    state = torch.load(folder / "longer" / "state.pt", weights_only=True)
    assert (state["step"], len(state["losses"])) == (6, 6)


@pytest.mark.parametrize("keep", [0, 100, -1])
def test_a_damaged_state_is_named(folder, run, keep):
    damaged = folder / f"damaged {keep}"
    train_field(run, damaged, SHORT)
    state = damaged / "state.pt"
    state.write_bytes(state.read_bytes()[:keep])
    with pytest.raises(SurveyError, match=r"state\.pt cannot be read .*; delete it, and training begins anew"):
        train_field(run, damaged, SHORT)


def test_a_folder_with_other_files_is_left_alone(folder, run):
    (folder / "mine").mkdir()
    (folder / "mine" / "notes.txt").write_text("keep")
    with pytest.raises(OutputError, match="is not empty and holds no volume"):
        train_field(run, folder / "mine", SHORT)
    with pytest.raises(OutputError, match="is not empty and holds no volume"):
        train_field(run, folder / "s" / "images", SHORT)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"model": "gaussians"}, "there is no model gaussians; expected one of mdw"),
        ({"steps": 0}, "steps is 0, expected a number of at least 1"),
        ({"image_scale": 2.0}, "image_scale is 2, expected a number above 0 and at most 1"),
        ({"density": -1.0}, "density is -1, expected a number above 0"),
    ],
)
def test_options_without_sense_are_refused(wrong, said):
    with pytest.raises(SurveyError, match=said):
        VolumeOptions(**wrong)


@pytest.mark.parametrize(
    ("given", "needed", "said"),
    [
        ({"drop": "none"}, {"submodules": "2x1"}, "--drop has no effect without --submodules"),
        ({"density": 3.0}, {"rule": Rule.density}, "--density has no effect without --extract density"),
        ({"dry": True}, {"cameras": "a.csv"}, "--dry has no effect without --cameras"),
        ({"losses": Losses(transparency=0.1)}, {"shell": True}, r"transparency has no effect without --shell"),
        (
            {"losses": Losses(patch_px=4)},
            {"losses": Losses(patch_px=4, ssim=0.1)},
            "patch_px has no effect without ncc, ssim or virtual_patches",
        ),
    ],
)
def test_an_option_without_effect_is_refused_and_taken_where_it_has_one(given, needed, said):
    with pytest.raises(SurveyError, match=f"{said}; give both or leave it out"):
        VolumeOptions(**given)
    assert VolumeOptions(**(given | needed)).of_losses().patch in (1, 4)


def test_losses_that_are_given_take_the_place_of_those_that_monocular_priors_have_by_default(tmp_path):
    given = Losses(normal=0.2, distortion=0.1)
    assert VolumeOptions(monocular=tmp_path, losses=given).of_losses() == given
    depth, normal = MONOCULAR
    beside = VolumeOptions(monocular=tmp_path, losses=Losses(distortion=0.1)).of_losses()
    assert beside == Losses(distortion=0.1, depth=depth, normal=normal)


def test_the_shell_is_seen_where_the_bed_does_not_fill_the_picture(folder, run):
    table = folder / "beside.csv"
    head, first, *_ = (folder / "s" / "cameras.csv").read_text().splitlines()
    table.write_text(f"{head}\n{first}\n")
    with LoadedRun(run) as loaded:
        low, high = np.percentile(loaded.columns("points_crs")["points_crs"][:, :2], [30, 70], axis=0)
    alpha = {}
    for shell in (False, True):
        output = folder / f"shell {shell}"
        train_field(run, output, replace(SHORT, shell=shell, cameras=table, bounds=(*low, *high)))
        (picture,) = (output / "views").glob("*[0-9].png")
        with Image.open(picture) as image:
            pixels = np.asarray(image)
        alpha[shell] = pixels[..., 3]
        assert not pixels[pixels[..., 3] == 0][:, :3].any()
    assert (alpha[False] == 0).any()
    assert (alpha[True] == 255).all()


def test_bounds_without_a_bed_are_refused(folder, run):
    with pytest.raises(SurveyError, match=r"no bed lies in --bounds 0 0 1 1; it reaches from"):
        train_field(run, folder / "h", replace(SHORT, bounds=(0.0, 0.0, 1.0, 1.0)))


def test_straight_rays_put_the_surface_elsewhere(folder, run):
    """Without the water there is no column to learn, and the settings differ."""
    report = train_field(run, folder / "straight", replace(SHORT, straight=True))
    assert report["points"] > 100
    with pytest.raises(OutputError, match="straight: True there, False asked for"):
        train_field(run, folder / "straight", SHORT)


def test_the_command_prints_what_was_found(folder, run):
    found = bathynerf(
        "field", run, "-o", folder / "c", "--model", NAME, "--steps", 2, "--rays", 32, "--samples", 8,
        "--cells", 16, "--image-scale", 0.5,
    )  # fmt: skip
    assert found.exit_code == 0, found.stderr
    assert NAME in found.stdout
    assert "over the run's bed" in found.stdout


def test_the_survey_says_what_no_option_does(folder, run):
    toml = folder / "s" / "survey.toml"
    before = toml.read_text()
    toml.write_text(before + '\n[field]\nmodel = "hash"\nsteps = 3\ncells = 16\n[field.losses]\ndistortion = 0.01\n')
    try:
        options = volume_options(FieldConfig(steps=2, rays=8).over(field_config(run, None)), seed=5)
    finally:
        toml.write_text(before)
    assert (options.model, options.steps, options.rays, options.cells) == ("hash", 2, 8, 16)
    assert (options.samples, options.seed) == (VolumeOptions().samples, 5)
    assert options.of_losses().distortion == 0.01
    assert field_config(run, str(folder)) == FieldConfig()


def test_a_run_that_was_copied_with_its_survey_reads_the_settings_of_the_copy(folder, run, tmp_path):
    copied = shutil.copytree(folder / "s", tmp_path / "copy")
    shutil.copytree(run, copied / "bathynerf")
    with (copied / "survey.toml").open("a") as stream:
        stream.write('\n[field]\nmodel = "hash"\n')
    assert field_config(copied / "bathynerf", None).model == "hash"
    assert field_config(run, None).model is None
    with RunDir(copied / "bathynerf") as of_copy:
        of_copy.claim(Owner.of("s", {path.name: path for path in (folder / "s" / "images").iterdir()}), is_inside=True)
    assert field_config(copied / "bathynerf", None).model == "hash"
    # Of another survey, into whose folder the run was written.
    next((copied / "images").iterdir()).write_bytes(b"another")
    assert field_config(copied / "bathynerf", None).model is None


def test_as_published_takes_the_numbers_of_the_paper_where_none_is_given():
    options = volume_options(FieldConfig(model="nerfacto", rays=8, as_published=True))
    assert (options.steps, options.rays, options.cells) == (30_000, 8, 512)
    assert options.of_losses() == Losses(distortion=0.002)
    assert volume_options(FieldConfig(as_published=True)).steps == 150_000
    with pytest.raises(SurveyError, match="--as-published is given, and no paper describes hash; leave it out"):
        volume_options(FieldConfig(model="hash", as_published=True))
    with pytest.raises(SurveyError, match="as_published has no effect without volume_options"):
        VolumeOptions(as_published=True)
    for entry in MODELS.values():
        VolumeOptions(**entry.published)


def test_what_is_taken_from_the_paper_is_said(folder, run):
    small = ("--rays", 32, "--cells", 16, "--image-scale", 0.5, "--steps", 1)
    for model, said in (("tinynerf", "samples 32"), ("nerfacto", "distortion 0.002")):
        found = bathynerf("field", run, "-o", folder / model, "--model", model, "--as-published", *small)
        assert found.exit_code == 0, found.stderr
        assert f"as published: {said}; what is not as in the paper" in found.output


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[field]\nstep = 3", r"unknown key step in \[field\]; the nearest known one is \[field\] steps"),
        ("[field.losses]\nncc = -1.0", r"field\.losses\.ncc is -1, expected 0 or more"),
        ("[field.losses]\npatch_px = 1", r"field\.losses\.patch_px is 1, expected 3 or more"),
    ],
)
def test_settings_of_fields_without_sense_are_refused(text, said):
    with pytest.raises(ConfigError, match=said):
        parse_config(text)


def test_monocular_depth_and_normals_are_learned_from(folder, run):
    priors = folder / "mono"
    priors.mkdir()
    with Image.open(folder / "s" / "images" / "0000.png") as picture:
        width, height = picture.size
    np.save(priors / "0002_depth.npy", np.linspace(1.0, 2.0, width * height).reshape(height, width))
    np.save(priors / "0001_normal.npy", np.tile(np.float32([0.0, 0.0, -1.0]), (height // 2, width // 2, 1)))
    options = replace(SHORT, monocular=priors)
    assert options.of_losses() == Losses(depth=0.1, normal=0.05)
    report = train_field(run, folder / "with mono", options)
    plain = train_field(run, folder / "without mono", SHORT)
    assert report["training"]["psnr_db"] != plain["training"]["psnr_db"]
    with pytest.raises(OutputError, match=r"monocular: [0-9a-f]+ there, None asked for"):
        train_field(run, folder / "with mono", SHORT)


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("0001_depth.npy", np.zeros((4, 4, 3)), r"holds an array \(4, 4, 3\), expected numbers \(height, width\)"),
        ("0001_depth.npy", np.zeros((10, 100)), "is 100 x 10 px, and its photograph is"),
        ("0001_normal.npy", np.tile([0.0, 0.0, 1.0], (48, 64, 1)), "100 % of its normals point away from the camera"),
        ("other_depth.npy", np.zeros((48, 64)), "has no depth or normals of any of"),
    ],
)
def test_priors_that_cannot_be_meant_are_refused(folder, run, tmp_path, name, values, said):
    np.save(tmp_path / name, values)
    with pytest.raises(SurveyError, match=said):
        train_field(run, tmp_path / "out", replace(SHORT, monocular=tmp_path))


@pytest.mark.parametrize("suffix", [".npy", ".tif", ".png"])
def test_normals_turn_with_the_camera_whatever_file_holds_them(tmp_path, suffix):
    """A normal that points at a camera is its axis reversed, in local."""
    turn = Rotation.from_euler("xyz", (200.0, 10.0, 40.0), degrees=True).as_matrix()
    camera = PinholeCamera(np.zeros(3), turn, 50.0, 50.0, 32.0, 24.0, 64, 48)
    normals = np.tile(np.float32([0.0, 0.0, -1.0]), (48, 64, 1))
    normals[:, :40] = np.nan
    path = tmp_path / f"a_normal{suffix}"
    if suffix == ".npy":
        np.save(path, normals)
    else:
        whole = np.tile(np.float32([-1.0, 0.0, 0.0]), (48, 64, 1))  # blue first
        cv2.imwrite(str(path), whole if suffix == ".tif" else np.round(127.5 * (whole + 1.0)).astype(np.uint8))
    (found,) = monocular_priors(tmp_path, ["a.jpg"], [camera])
    # A step of 8 bits is 0.008.
    np.testing.assert_allclose(found.normal[20, 60], -turn[2], atol=0.01)


def test_losses_on_priors_need_priors():
    with pytest.raises(SurveyError, match="name their folder with --monocular DIR"):
        VolumeOptions(losses=Losses(depth=0.1))
