"""Axes in metres and in degrees; cells lie around their positions."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure
from pyproj import Geod

from radiotwin.display import PlotFrame, draw_cells
from radiotwin.errors import BadInput
from radiotwin.io.forms import Origin

matplotlib.use("Agg")
ORIGIN = Origin(latitude_deg=60.0, longitude_deg=10.0)


def test_degrees_are_those_of_the_geodesic():
    """Points 1 km along a bearing from the origin, by PROJ's geodesics, which the frame does not use."""
    for bearing_deg in (0.0, 37.0, 90.0, 250.0):
        longitude, latitude, _ = Geod(ellps="WGS84").fwd(10.0, 60.0, bearing_deg, 1000.0)
        x_m, y_m = 1000 * np.sin(np.radians(bearing_deg)), 1000 * np.cos(np.radians(bearing_deg))
        assert PlotFrame(ORIGIN).at(x_m, y_m) == (pytest.approx(longitude, abs=1e-9),
                                                  pytest.approx(latitude, abs=1e-9))
    assert PlotFrame().at(3.0, 4.0) == (3.0, 4.0)


def test_the_frame_is_chosen_and_said():
    assert PlotFrame.choose(ORIGIN, None).origin == ORIGIN and PlotFrame.choose(ORIGIN, False).origin is None
    assert PlotFrame.choose(None, None).origin is None
    with pytest.raises(BadInput, match="origin of the frame is not known"):
        PlotFrame.choose(None, True)
    for frame, labels, aspect in ((PlotFrame(), ("x, east [m]", "y, north [m]"), 1.0),
                                  (PlotFrame(ORIGIN), ("longitude [°]", "latitude [°]"), 2.0)):  # 1 / cos 60°
        ax = Figure().subplots()
        frame.prepare(ax)
        assert (ax.get_xlabel(), ax.get_ylabel()) == labels and ax.get_aspect() == pytest.approx(aspect)


@pytest.mark.parametrize("x_m, y_m, borders", [
    ([0.0, 10.0, 20.0], [5.0, 15.0], (-5, 25, 0, 20)), ([0.0], [0.0, 4.0], (-2, 2, -2, 6)),
    ([7.0], [7.0], (6.5, 7.5, 6.5, 7.5))])
def test_cells_lie_around_their_positions(x_m, y_m, borders):
    ax = Figure().subplots()
    draw_cells(ax, PlotFrame(), np.array(x_m), np.array(y_m), np.zeros((len(y_m), len(x_m))))
    assert (*ax.get_xlim(), *ax.get_ylim()) == borders
