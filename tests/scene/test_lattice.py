"""The lattice: what lies on it, and in which order."""

from io import StringIO

import numpy as np
import pytest
from rich.console import Console

from radiotwin.errors import BadInput
from radiotwin.scene import Scene
from radiotwin.scene.build import BuildOptions, build_scene, print_report
from radiotwin.scene.lattice import Lattice


def test_both_borders_belong_to_it():
    lattice = Lattice.over(0, 600, 0, 800, 20, [65, 55, 60])
    assert lattice.shape == (3, 41, 31)
    np.testing.assert_array_equal(lattice.z_m, [55, 60, 65])
    assert lattice.x_m[-1] == 600 and lattice.y_m[-1] == 800 and lattice.step_m == 20
    assert Lattice.over(0, 50, -10, 10, 20, [1]).shape == (1, 2, 3), "a step that does not fit stays inside"


@pytest.mark.parametrize(("extent_m", "step_m"), [((0, 1e6, 0, 1e6), 1e-3), ((0, 1e308, -1e308, 0), 1e-9)])
def test_a_lattice_has_a_budget_before_it_has_memory(extent_m, step_m):
    with pytest.raises(BadInput, match=r"positions; at most [0-9,]+ .* RADIOTWIN_MAX_POSITIONS"):
        Lattice.over(*extent_m, step_m, [50.0])


def test_index_of_many_positions_takes_little_memory():
    lattice = Lattice.over(0, 1999, 0, 4, 1, [10.0, 20.0])
    order = np.random.default_rng(0).permutation(len(lattice.positions_m))
    assert (lattice.index_of(lattice.positions_m[order] + 0.009) == order).all()
    for y_m in (2.5, np.nan):
        with pytest.raises(BadInput, match="not on the lattice"):
            lattice.index_of(np.array([[0.0, y_m, 10.0]]))


def test_a_lattice_that_is_asked_for(town, tmp_path):
    """Its extent is in the frame of the file, and moves with the city."""
    options = BuildOptions(extent_m=(-30, 30, -20, 20), step_m=5.0, altitudes_m=(3.0, 1.5), devices=2)
    report = build_scene(town.write(), tmp_path / "out", options)
    assert report.extent_m == (-30, 30, -20, 20) and report.step_m == 5.0
    scene = Scene.load(tmp_path / "out")
    assert scene.lattice.shape == (2, 9, 13) and scene.lattice.z_m.tolist() == [1.5, 3.0]
    assert scene.city.height_at(-60.0, -60.0) == pytest.approx(8.0)  # buildings around it are kept
    text = StringIO()
    print_report(report, Console(file=text, width=200))
    assert "3, 1.5 m" in text.getvalue() and "of the roofs" not in text.getvalue()
