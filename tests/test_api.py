"""`import radiotwin as rt`: quick, complete, and the documented lines run as they are."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import radiotwin as rt

ROOT = Path(__file__).parents[1]
HEAVY = ("torch", "numpy", "pandas", "matplotlib", "mitsuba", "scipy")


def test_importing_loads_nothing_heavy():
    code = f"import sys, radiotwin; print([name for name in {HEAVY} if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_every_name_is_there_for_people_and_for_type_checkers():
    for name in rt.__all__:
        assert getattr(rt, name) is not None and name in dir(rt)
    tree = ast.parse(Path(rt.__file__).read_text())
    checked = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name: node.module for node in checked.body for alias in node.names}
    assert {**seen, "__version__": None}.keys() == set(rt.__all__)
    assert all(module == f"radiotwin.{rt._MODULE_OF[name]}" for name, module in seen.items())
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = rt.nothing


def test_the_documented_lines_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    first, second = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len([line for line in first.splitlines() if line]) <= 12
    names = {}
    exec(compile(first, "docs/python.md", "exec"), names)
    assert {type(names[name]).__name__ for name in ("scene", "truth", "measurements", "twin", "loop")} == {
        "Scene", "RadioMap", "Measurements", "Twin", "Loop"}
    assert 0 < float(capsys.readouterr().out.split()[0]) < 5
    assert (tmp_path / "quick" / "twin" / "twin.json").is_file() and (tmp_path / "quick" / "report.html").is_file()
    exec(compile(second, "docs/python.md", "exec"), names)
    assert names["prediction"].mean_db.shape == (2,) and (names["prediction"].sd_db > 0).all()
    described = (ROOT / "docs" / "close-the-loop.md").read_text(encoding="utf-8")
    assert all(f"`{key}`" in described for key in rt.make_report(names["loop"]))
