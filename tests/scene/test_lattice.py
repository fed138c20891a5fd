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


def test_a_step_that_does_not_fit_stays_inside():
    assert Lattice.over(0, 50, -10, 10, 20, [1]).shape == (1, 2, 3)


def test_positions_and_their_indices_agree():
    lattice = Lattice.over(-20, 20, 0, 60, 20, [50, 60])
    np.testing.assert_array_equal(lattice.index_of(lattice.positions_m), np.arange(2 * 4 * 3))


def test_a_position_off_the_lattice_is_refused():
    with pytest.raises(BadInput, match="not on the lattice"):
        Lattice.over(0, 40, 0, 40, 20, [50]).index_of(np.array([[20.0, 25.0, 50.0]]))


def test_a_lattice_has_a_budget_before_it_has_memory():
    with pytest.raises(BadInput, match=r"1e\+18 positions; at most [0-9,]+ .* RADIOTWIN_MAX_POSITIONS"):
        Lattice.over(0, 1e6, 0, 1e6, 1e-3, [50.0])
    with pytest.raises(BadInput, match="positions"):
        Lattice.over(0, 1e308, -1e308, 0, 1e-9, [50.0])


def test_index_of_many_positions_takes_little_memory():
    lattice = Lattice.over(0, 1999, 0, 4, 1, [10.0, 20.0])
    order = np.random.default_rng(0).permutation(len(lattice.positions_m))
    assert (lattice.index_of(lattice.positions_m[order] + 0.009) == order).all()
    with pytest.raises(BadInput, match="not on the lattice"):
        lattice.index_of(np.array([[0.0, np.nan, 10.0]]))


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
