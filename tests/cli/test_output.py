"""What every command has: --quiet, --json where there are tables, no colours in pipes, seeds, completion."""

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from radiotwin.cli import app
from radiotwin.command import TABLES, add_output_options
from radiotwin.console import print_rows, say

COMMAND = Path(sys.executable).with_name("radiotwin")
AT_RANDOM = ("build-scene", "trace", "survey", "fit", "compare", "close-loop", "demo")


def invoke(*words):
    """A command of a small app that prints a message and a table, or ends with a finding."""
    small = typer.Typer()

    @small.command("fit")
    def table(number: float = 1.0, finding: bool = False) -> None:
        say("read it")
        print_rows("A [table]", {"device": "left", "x [m]": "right", "": "left"}, [["d0", number, "a"]])
        if finding:
            raise typer.Exit(2)

    @small.command("map")
    def plain() -> None:
        say("wrote it")

    add_output_options(small)
    return CliRunner().invoke(small, words)


def test_tables_and_messages_as_json():
    done = invoke("fit", "--number", "nan", "--json")
    assert done.exit_code == 0
    assert json.loads(done.stdout) == {"messages": ["read it"], "tables": [
        {"title": "A [table]", "rows": [{"device": "d0", "x [m]": None, "column 3": "a"}]}]}
    again = json.loads(invoke("fit", "--number", "2.5", "--json", "--finding").stdout)
    assert again["tables"][0]["rows"][0]["x [m]"] == 2.5, "nothing is left of the run before"
    assert invoke("fit", "--finding", "--json").exit_code == 2
    assert invoke("map", "--json").exit_code == 2, "a command without tables has no such option"


def test_quiet_prints_nothing_and_text_is_as_ever():
    assert invoke("fit", "--quiet").stdout == "" and invoke("map", "-q").stdout == ""
    text = invoke("fit", "--number", "2.5").stdout
    assert "read it" in text and "A [table]" in text and "2.50" in text


def test_every_command_has_its_options():
    options = {command.name: inspect.signature(command.callback).parameters for command in app.registered_commands}
    assert set(TABLES) <= options.keys() and all("quiet" in names for names in options.values())
    assert {name for name, names in options.items() if "as_json" in names} == set(TABLES)
    assert all("seed" in options[name] for name in AT_RANDOM)


def test_the_real_command(run_installed, run, tmp_path):
    done = run_installed("build-scene preset:small -o city --json", tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["scene"]["devices"] == 7 and document["scene"]["materials"][0]["name"]
    assert any("wrote city" in message for message in document["messages"])
    quiet = run("build-scene preset:small -o again -q", tmp_path)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "") and (tmp_path / "again/scene.toml").is_file()
    text = run("build-scene preset:small --check", tmp_path).stdout
    assert "buildings" in text or "shapes" in text
    assert "\x1b" not in text, "no colours where nobody looks"


def test_bad_input_is_no_json(run, tmp_path):
    done = run("fit nothing.csv --scene nowhere --json", tmp_path)
    assert done.returncode == 2 and done.stdout == "" and "does not exist" in done.stderr


@pytest.mark.parametrize("words, expected", [("radiotwin clo", "close-loop"),
                                             ("radiotwin fit --allow", "--allow-indoor")])
def test_the_shell_completes(words, expected):
    result = subprocess.run([str(COMMAND)], capture_output=True, text=True, env=os.environ | {
        "_RADIOTWIN_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)})
    assert expected in result.stdout.split()


def test_planning_has_the_same_options(small_scene, tmp_path):
    words = ["--scene", str(small_scene.folder), "--truth", "segmented", "--algorithm", "random", "--twin",
             "log-distance", "--real-episodes", "1", "--planner-iterations", "50", "--flights", "2", "--json", "--out",
             "run"]
    done = subprocess.run([sys.executable, "-m", "marl.fedqmix", *words], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["tables"][0]["rows"]
    assert [row["method"] for row in rows] == ["random", "planner", "greedy"]
