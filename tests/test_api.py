"""`import radiotwin as rt`: quick, complete, and the documented lines run as they are."""

import ast
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
from radiotwin.cli.commands import app
from tests.worlds import leave_effects, quickened, thinned

ROOT = Path(__file__).parents[1]
# Command -> functions of `rt` that do its work; a command calls them, or (after the arrow) what they call, too.
COMMANDS = {
    "build-scene": ["build_scene"], "export-scene": ["export_scene"], "export": ["export_ns3", "read_points"],
    "trace": ["trace_map", "choose_quality"],
    "gains": ["trace_points", "read_points"], "paths": ["list_paths", "read_points"],
    "survey": ["fly_survey", "read_truth"], "import": ["import_measurements → import_files"], "fit": ["fit_twin"],
    "map": ["export_map"], "coverage": ["predict_coverage"], "compare": ["compare_held_out", "write_comparison_folder"],
    "close-loop": ["close_loop", "write_closeloop_folder", "write_corrected_scene"],
    "locate": ["locate_devices", "position_errors"], "plan": [],  # `marl.plan_flights`, which is not of `radiotwin`
    "report": ["read_run", "write_report"], "demo": ["run_demo"],
    "doctor": ["diagnose"], "cache": ["cache_content", "clear_cache"],
}
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


def test_every_function_and_object_is_documented():
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    table = text.partition("## Functions")[2].partition("## Predictions")[0]
    functions = {each.partition(" → ")[0] for names in COMMANDS.values() for each in names}
    assert all(f"`{name}`" in table or f"`{name}(" in table for name in functions)


def called_by(module_path, function):
    """Return the names that a function of a module imports or calls, and those of the module's own that it calls."""
    tree = ast.parse(Path(module_path).read_text(encoding="utf-8"))
    bodies = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    names, waiting, seen = set(), [function], set()
    while waiting:
        name = waiting.pop()
        seen.add(name)
        for node in ast.walk(bodies[name]):
            if isinstance(node, ast.ImportFrom):
                names.update(alias.name for alias in node.names)
            elif isinstance(node, ast.Name):
                names.add(node.id)
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "rt":
                names.add(node.attr)
        waiting += [each for each in names & bodies.keys() if each not in seen]
    return names


def test_every_command_is_declared():
    assert {command.name for command in app.registered_commands} == COMMANDS.keys()


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_calls_a_function_that_python_has(command):
    callback = inspect.unwrap(next(each.callback for each in app.registered_commands if each.name == command))
    called = called_by(inspect.getsourcefile(callback), callback.__name__)
    for entry in COMMANDS[command]:
        name, _, inner = entry.partition(" → ")
        function = getattr(rt, name)
        assert name in rt.__all__ and callable(function)
        assert (inner or name) in called
        assert not inner or inner in called_by(inspect.getsourcefile(function), name)


@pytest.mark.parametrize("name", sorted({each.partition(" → ")[0] for names in COMMANDS.values() for each in names}))
def test_functions_have_defaults_where_commands_have(name):
    """What a command leaves open, a function leaves open, too: seed, flights, pattern, model and the like."""
    parameters = inspect.signature(getattr(rt, name)).parameters
    command = next(key for key, names in COMMANDS.items() if any(each.split(" ")[0] == name for each in names))
    callback = next(each.callback for each in app.registered_commands if each.name == command)
    for option, declared in inspect.signature(callback).parameters.items():
        if option in parameters and declared.default not in (inspect.Parameter.empty, None):  # None: not wanted
            assert parameters[option].default is not inspect.Parameter.empty, option
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
