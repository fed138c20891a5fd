"""What is installed, and what SECURITY.md promises about it."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from radiotwin.errors import MissingPackage
from radiotwin.io import budgets
from radiotwin.trace import SolverSettings, mended

ROOT = Path(__file__).parents[1]


def normal(name):
    return re.sub("[-_.]+", "-", name).lower()


def pinned(text):
    """Return name -> version of lines such as `name==1.0`."""
    return {normal(name): version for name, version in re.findall(r"^([\w.-]+)==([^\s;\\]+)", text, re.MULTILINE)}


@pytest.mark.parametrize("kind", ["", "-flower"])
def test_the_lock_file_has_the_versions_of_the_constraints_and_a_hash_for_each(kind):
    lock = (ROOT / f"requirements{kind}.lock").read_text()
    constraints, locked = pinned((ROOT / f"constraints{kind}.txt").read_text()), pinned(lock)
    assert {name: locked.get(name) for name in constraints} == constraints
    entries = re.split(r"^(?=[\w.-]+==)", lock, flags=re.MULTILINE)
    assert "uv pip compile pyproject.toml" in entries[0] and "--default-index https://pypi.org/simple" in entries[0]
    assert len(entries) - 1 == len(locked)
    assert all(re.search(r"--hash=sha256:[0-9a-f]{64}", entry) for entry in entries[1:])
    assert not re.search(r"extra-index|^-|https?://(?!pypi)", lock, re.MULTILINE)


def test_the_lock_file_has_every_declared_dependency():
    declared = (ROOT / "pyproject.toml").read_text().split("[project.scripts]")[0].split("dependencies = [")[1]
    names = {normal(name) for name in re.findall(r'"([A-Za-z][\w.-]*)(?:\[\w+\])?>=', declared)}
    flower = {"flwr"}  # it pins older versions of what others have: a lock file of its own
    assert len(names) > 30 and names - flower <= pinned((ROOT / "requirements.lock").read_text()).keys()
    assert flower <= names & pinned((ROOT / "requirements-flower.lock").read_text()).keys()


def test_flowers_constraints_differ_from_the_others_only_where_flower_needs_it():
    own, others = (pinned((ROOT / f"constraints{kind}.txt").read_text()) for kind in ("-flower", ""))
    assert {name for name in own if others.get(name, own[name]) != own[name]} == {
        "typer", "rich", "packaging", "protobuf", "ray"}


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_all_is_every_extra_of_a_user(project):
    extras = project["optional-dependencies"]
    (every,) = extras["all"]
    assert set(re.fullmatch(r"radiotwin\[(.*)\]", every)[1].split(",")) == extras.keys() - {"all", "docs", "flower", "test"}
    listed = re.findall(r"^\| `(\w+)`(?:, `(\w+)`)? \|", (ROOT / "docs" / "install.md").read_text().split("**Without an extra**")[1], re.MULTILINE)
    assert {name for names in listed for name in names if name} == extras.keys()


def test_the_conda_recipe_has_the_dependencies(project):
    conda = {"torch": "pytorch", "matplotlib": "matplotlib-base"}
    recipe = (ROOT / "recipe" / "recipe.yaml").read_text()
    run, extra = recipe.split("  run:\n")[1].split("\n\n")[0].split("  run_constraints:\n")
    extras = project["optional-dependencies"]
    for text, requirements in ((run, [*project["dependencies"], f"python{project['requires-python']}"]),
                               (extra, [*extras["trace"], *extras["nn"], *extras["train"]])):
        specs = dict(re.match(r"([\w.-]+)>=([\d.]+)", each).groups() for each in requirements if not each.startswith("radiotwin["))
        assert dict(re.findall(r"(?:- |then: )(?!if:)([\w.-]+) >=([\d.]+)$", text, re.MULTILINE)) == {
            conda.get(name, name): version for name, version in specs.items()}


def test_a_tree_without_git_has_one_version_everywhere():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    version = tools["setuptools_scm"]["fallback_version"]
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert f'default="{version}"' in (ROOT / "recipe" / "recipe.yaml").read_text()
    assert f"ARG VERSION={version}\n" in (ROOT / "Dockerfile").read_text()


def test_every_budget_is_in_the_table():
    table = re.findall(r"^\| `(\w+)` \| ([\d,]+) \| ([^|]+) \| ([^|]+) \|$", (ROOT / "SECURITY.md").read_text(), re.MULTILINE)
    assert table == [(each.variable, f"{each.default:,}", each.unit, each.of) for each in vars(budgets).values()
                     if isinstance(each, budgets.Budget)]


def test_nothing_takes_packages_from_two_indexes():
    for name in ("README.md", "Makefile", "SECURITY.md", "CONTRIBUTING.md"):
        lines = [line for line in (ROOT / name).read_text().splitlines() if "--extra-index-url " in line]
        assert not lines, name


WITHOUT_EXTRAS = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "tensorboard", "sionna", "mitsuba", "drjit", "pythreejs"}:
            raise ModuleNotFoundError(f"No module named {name!r}")

sys.meta_path.insert(0, Absent())
import radiotwin
for name in radiotwin.__all__:
    getattr(radiotwin, name)
import radiotwin.cli.commands
import marl.plan_flights, marl.plan_output
from radiotwin.errors import MissingPackage
from radiotwin.propagation.laws import channel_named
try:
    channel_named("segmented_nn")().fit(None, None, None)
except MissingPackage as error:
    print(error)
"""


def test_without_torch_and_sionna_rt_everything_is_imported_and_the_network_names_its_extra():
    done = subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS], capture_output=True, text=True, timeout=300, check=True)
    assert "pip install 'radiotwin[nn]'" in done.stdout


def test_tracing_without_sionna_rt_names_its_extra(monkeypatch):
    def absent(name):
        raise PackageNotFoundError(name)

    monkeypatch.setattr(mended, "version", absent)
    with pytest.raises(MissingPackage, match=re.escape("pip install 'radiotwin[trace]'")):
        SolverSettings()
