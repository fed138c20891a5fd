"""`import radiotwin as rt`: quick, complete, and the documented lines run as they are."""

import contextlib
import inspect
import io
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

import radiotwin as rt
from tests.worlds import leave_effects, quickened, thinned

ROOT = Path(__file__).parents[1]
COMMANDS = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "radiotwin" / "cli").glob("*.py"))
FUNCTIONS = sorted({*re.findall(r"\brt\.([a-z_0-9]+)\(", COMMANDS), "import_measurements"})
HEAVY = ("torch", "numpy", "pandas", "matplotlib", "mitsuba", "scipy")


def test_importing_loads_nothing_heavy():
    code = f"import sys, radiotwin; print([name for name in {HEAVY} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_every_name_is_there_for_people_and_for_type_checkers():
    for name in rt.__all__:
        assert getattr(rt, name) is not None and name in dir(rt)
    assert {*rt._modules(), "__version__"} == set(rt.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = rt.nothing


@pytest.fixture(scope="module")
def documented(tmp_path_factory):
    """The names that all snippets of docs/python.md leave, run one after another in an empty folder, and the folder.

    Of the flights every fourth moment, and of the effects two: all take minutes.
    """
    folder, text = tmp_path_factory.mktemp("documented"), (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    snippets = re.findall(r"```py.*?\n(.*?)```", text, re.DOTALL)
    assert len(snippets) == text.count("```") / 2 == 8
    matplotlib.use("Agg")
    names, printed, fly = {}, io.StringIO(), rt.fly_survey
    with quickened(), contextlib.chdir(folder), contextlib.redirect_stdout(printed), pytest.MonkeyPatch.context() as patch:
        leave_effects(patch, "receiver_gain_offset", "noise_floor_censoring")
        patch.setattr("radiotwin.maps.survey.fly_survey", lambda *given, **more: thinned(fly(*given, **more), 4))
        for snippet in snippets:
            exec(compile(snippet, "docs/python.md", "exec"), names)
    return names, folder / "quick", printed.getvalue()


def test_the_documented_lines_run(documented):
    names, folder, printed = documented
    kinds = ("Scene", "RadioMap", "Measurements", "Twin", "Loop", "MapDifference", "Residuals")
    assert [type(names[name]).__name__ for name in ("scene", "truth", "measurements", "twin", "loop", "difference",
                                                    "residuals")] == list(kinds)
    assert 0 < float(printed.split()[0]) < 5
    made = ("twin/twin.json", "report.html", "plots.png", "d3.csv", "city.glb",
            "imported/measurements.csv", "block/scene.toml")
    assert [name for name in made if not (folder / name).is_file()] == []
    assert names["prediction"].mean_db.shape == (2,) and (names["prediction"].sd_db > 0).all()
    assert names["block"].config.origin == names["imported"].origin and len(names["imported"]) == 2
    assert set(names["positions"]["device"]) == {device.device for device in names["scene"].config.devices
                                                 if device.role == "unknown"}
    assert len((folder / "d3.csv").read_text().splitlines()) == 1 + 16 * 16
    assert (names["first"]["path_gain_db"].values < 0).all() and names["listed"].sizes["link"] == 2 * 7


def test_what_closeloop_json_holds_is_documented(documented):
    described = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    assert all(f"`{key}`" in described for key in rt.make_report(documented[0]["loop"]))


def test_every_function_that_a_command_calls_is_documented():
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    table = text.partition("## Functions")[2].partition("## Predictions")[0]
    assert [name for name in FUNCTIONS if not re.search(rf"\b{name}[`(]", table)] == ["read_measurements"]  # which is `load`
    assert len(FUNCTIONS) > 25


@pytest.mark.parametrize("name", FUNCTIONS)
def test_functions_have_defaults_where_commands_have(name):
    """What a command leaves open, a function leaves open, too."""
    parameters = inspect.signature(getattr(rt, name)).parameters
    for option in ("seed", "flights", "pattern", "model", "settings"):
        if option in parameters and parameters[option].kind is not inspect.Parameter.VAR_KEYWORD:
            assert parameters[option].default is not inspect.Parameter.empty, option


@pytest.mark.parametrize("command", [
    ["-m", "radiotwin", "--version"], ["-m", "marl.fedqmix", "--help"],
    ["-c", "import marl.flights"],
    ["-c", "import radiotwin.propagation.paths.surfaces, marl.environment, numba, sys; assert '' in sys.path"]])
def test_an_output_folder_named_coverage_does_no_harm(tmp_path, command):
    """numba would take it for the package of that name; it is imported by both packages."""
    (tmp_path / "coverage").mkdir()
    done = subprocess.run([sys.executable, *command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
