"""The documentation site builds without a single warning; tables of names are those of the code."""

import ast
import os
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from docs.made_tables import with_tables
from radiotwin.closeloop.verdict.criteria import SelectionCriteria
from tests.quotes import unquoted_figures, wrong_quotations

ROOT = Path(__file__).parents[1]


def test_the_site_builds(tmp_path):
    pytest.importorskip("mkdocs_jupyter", reason="the extra docs is not installed")
    pytest.importorskip("mkdocstrings", reason="the extra docs is not installed")
    result = subprocess.run(  # the examples have tests of their own
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-f", str(ROOT / "mkdocs.yml"), "-d",
         str(tmp_path / "site")], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"EXECUTE_EXAMPLES": "false", "NO_MKDOCS_2_WARNING": "1"})
    assert result.returncode == 0, result.stderr
    reference = (tmp_path / "site" / "reference.html").read_text(encoding="utf-8")
    for name in ("radiotwin.twin.fit_twin", "radiotwin.twin.Twin.predict", "radiotwin.maps.radiomap.RadioMap.load",
                 "radiotwin.closeloop.verdict.criteria.SelectionCriteria", "marl.interfaces.HarvestEnv",
                 "radiotwin.scene.readers.build.build_scene_from_map"):
        assert f'id="{name}"' in reference
    results = (tmp_path / "site" / "results.html").read_text(encoding="utf-8")
    for picture in re.findall(r'<img [^>]*src="([^"]+)"', results):
        assert (tmp_path / "site" / picture).is_file(), picture
    for path in (tmp_path / "site").rglob("*.html"):  # pages work from a file, without a network
        loaded = re.findall(r'<(?:script|img|iframe)[^>]* src="([^"]+)"', path.read_text(encoding="utf-8"))
        assert not [each for each in loaded if each.startswith(("http:", "https:", "//"))], path
    assert "rt.trace_map" in (tmp_path / "site" / "examples" / "city_to_map.html").read_text(encoding="utf-8")


def test_every_criterion_is_documented():
    """The reference shows the docstring, and the defaults from the code."""
    documented = re.findall(r"^        (\w+): ", SelectionCriteria.__doc__, re.MULTILINE)
    assert sorted(documented) == sorted(each.name for each in fields(SelectionCriteria))


@pytest.mark.parametrize("page", ["commands.md", "conventions.md", "effects.md", "import.md"])
def test_tables_from_the_code_are_made(page):
    made = with_tables((ROOT / "docs" / page).read_text(encoding="utf-8"))
    assert "::: made" not in made and made.count("| --- |") >= 1


def names_of(path):
    """Return the functions, classes, methods and constants of a module: `name` and `Class.name`."""
    found = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        found |= {each.id for each in targets if isinstance(each, ast.Name)}
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{each.name}" for each in node.body if isinstance(each, ast.FunctionDef)}
            found |= {f"{node.name}.{each.target.id}" for each in node.body if isinstance(each, ast.AnnAssign)}
    return found


def test_what_the_architecture_names_is_there():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = re.findall(r"`((?:radiotwin|marl|studies)/[\w/]+\.py):([\w.]+)`", text)
    missing = [f"{path}:{name}" for path, name in named
               if not (ROOT / path).is_file() or name not in names_of(ROOT / path)]
    assert not missing
    steps, concepts = text.split("## Where is")
    assert re.findall(r"^(\d)\. ", steps, re.MULTILINE) == list("12345678")
    assert len(re.findall(r"^\| .* \| `[\w/]+\.py:", concepts, re.MULTILINE)) >= 30


@pytest.mark.parametrize("page", [page for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
                                  if "<!--" in page.read_text(encoding="utf-8")], ids=lambda page: page.name)
def test_figures_that_are_quoted_are_those_of_the_tables(page):
    assert wrong_quotations(page.read_text(encoding="utf-8")) == []


def test_a_figure_that_differs_from_its_table_is_noticed():
    row = "<!--away: all quadrants; twin-->"
    assert wrong_quotations(f"9.1 dB{row}, 9.05{row}") == []
    assert [each[0] for each in wrong_quotations(f"8.9 dB{row}, 9.06{row}")] == ["8.9", "9.06"]
    assert unquoted_figures(f"9.1 dB{row} and 8.5 dB, 3 of 4, 12 flights") == ["8.5 dB", "3 of 4"]


@pytest.mark.parametrize("page, of_the_question", [  # settings, thresholds, licences: no results
    ("README.md", set()), ("docs/results.md", {"90 %", "1.5 m", "0.5", "0.7", "0.9", "0.45"}),
    ("docs/real-data.md", {"90 %", "2.0", "3.56", "3.69", "462.7"}), ("docs/scale.md", set()),
    ("docs/limitations.md", {"2.2", "36.777", "0.5 m", "0.7", "5.8", "90 %"}), ("docs/install.md", {"3.11", "3.12", "3.13"})])
def test_results_are_said_with_figures_of_tables_alone(page, of_the_question):
    text = (ROOT / page).read_text(encoding="utf-8")
    if page == "README.md":
        text = text.split("## How good is it")[1].split("**What it does not")[0]
    assert {each.strip("-–") for each in unquoted_figures(text)} <= of_the_question


def test_the_docs_stay_short():
    """Tables that are made from the code or by studies are not counted."""
    assert sum(page.stat().st_size for page in (ROOT / "docs").glob("*.md")) <= 250_000
