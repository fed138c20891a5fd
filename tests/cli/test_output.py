"""Options of every command: --quiet, --json where there are tables, seeds; no colours in pipes, completion."""

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from radiotwin.cli.commands import app
from radiotwin.runtime.command import TABLES, add_output_options
from radiotwin.runtime.console import print_rows, say

COMMAND = Path(sys.executable).with_name("radiotwin")
ROOT = str(Path(__file__).parents[2])
AT_RANDOM = ("build-scene", "trace", "survey", "fit", "compare", "close-loop", "demo")


def invoke(*arguments):
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
    return CliRunner().invoke(small, arguments)


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
    assert (tmp_path / "city" / "preview.png").stat().st_size > 10_000
    quiet = run("build-scene preset:small -o again -q", tmp_path)
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "") and (tmp_path / "again/scene.toml").is_file()
    text = run("build-scene preset:small --check", tmp_path).stdout
    assert "buildings" in text or "shapes" in text
    assert "\x1b" not in text, "no colours where nobody looks"


@pytest.mark.parametrize("arguments, part", [
    ("fit nothing.csv --scene nowhere --json", "does not exist"), ("fit --json", "Missing argument"),
    ("fit a.csv --nope 3 --json", "No such option"), ("nothing --json", "No such command"),
    ("trace scene --json", "No such option"), *((f"{command} --nope --json", "No such option") for command in TABLES)])
def test_an_error_is_json_too(arguments, part, run, tmp_path):
    done = run(arguments, tmp_path)
    error = json.loads(done.stdout)["error"]
    assert done.returncode == 2 == error["status"] and part in error["message"] and part in done.stderr


def test_wrong_options_are_one_message(run, tmp_path):
    done = run("fit a.csv --scene s --seed x\x1b[31m\u202e", tmp_path)
    assert done.returncode == 2 and done.stdout == "" and len(done.stderr.splitlines()) == 1
    assert "'--seed'" in done.stderr and "radiotwin fit --help shows" in done.stderr
    assert "\x1b" not in done.stderr and "\u202e" not in done.stderr
    assert run("", tmp_path).returncode == 2 and "close-loop" in run("--help", tmp_path).stdout


def shell(line, folder, **environment):
    """Run a line of the shell in which `$RADIOTWIN` is the command, as a process of its own."""
    program = f"{sys.executable} -c 'from radiotwin.cli import main; main()'"
    return subprocess.run(["bash", "-c", line.replace("$RADIOTWIN", program)], cwd=folder, capture_output=True,
                          text=True, timeout=60, env=os.environ | {"PYTHONPATH": ROOT} | environment)


@pytest.mark.parametrize("line, status, said", [
    ("$RADIOTWIN build-scene preset:small --check | true; exit ${PIPESTATUS[0]}", 141, 0),
    ("$RADIOTWIN cache --json >&-", 0, 0),
    ("$RADIOTWIN build-scene nothing 2>&-", 2, 0),
    ("$RADIOTWIN build-scene nothing 2>/dev/full", 2, 0),
    ("$RADIOTWIN cache --json >/dev/full", 1, 1),
    ("$RADIOTWIN --help >/dev/full", 1, 1)])
def test_an_output_that_takes_nothing_is_no_traceback(line, status, said, tmp_path):
    done = shell(line, tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (status, said), done.stderr
    assert "standard output cannot be written" in done.stderr or not said


@pytest.mark.parametrize("environment", [{"PYTHONIOENCODING": "ascii", "TERM": "dumb", "COLUMNS": "1"},
                                         {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}])
def test_any_terminal_will_do(environment, tmp_path):
    done = shell("$RADIOTWIN build-scene preset:small --check", tmp_path,
                 **environment)
    assert done.returncode == 0 and done.stderr == "" and "problems" in done.stdout.replace("\n", "")


@pytest.mark.parametrize("arguments, expected", [("radiotwin clo", "close-loop"),
                                             ("radiotwin fit --allow", "--allow-indoor")])
def test_the_shell_completes(arguments, expected):
    result = subprocess.run([str(COMMAND)], capture_output=True, text=True, env=os.environ | {
        "_RADIOTWIN_COMPLETE": "complete_bash", "COMP_WORDS": arguments, "COMP_CWORD": str(len(arguments.split()) - 1)})
    assert expected in result.stdout.split()


@pytest.mark.parametrize("given", [None, "2"])
def test_the_command_has_one_thread_of_blas_if_nothing_else_is_said(given):
    """Several wait for each other busily, and sums have another order for each number of them."""
    program = ("import sys; from radiotwin import cli; from radiotwin.io import signals; assert 'numpy' not in sys.modules\n"
               "signals.leave, sys.argv = (lambda status: None), ['radiotwin', '--version']\n"
               "cli.main()\n"
               "import numpy, threadpoolctl\n"
               "print({each['num_threads'] for each in threadpoolctl.threadpool_info() if each['user_api'] == 'blas'})")
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment | {
        "PYTHONPATH": ROOT} | ({"OPENBLAS_NUM_THREADS": given} if given else {}))
    threads = min(int(given or 1), os.cpu_count())
    assert done.stdout.splitlines()[-1] == f"{{{threads}}}", done.stderr
