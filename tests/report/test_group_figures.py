"""Heat maps of the residual: medians as a pivot table has them, and frames around what stands out."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from matplotlib.patches import Rectangle

from radiotwin.report.group_figures import groups_figure, pivot

LONG = "a_device_with_a_long_name_"


def campaign(devices, flights, receivers, links=6):
    """Data of a figure whose residuals are noise; some links are blank."""
    index = pd.MultiIndex.from_product([range(each) for each in (devices, flights, receivers, links)]).to_frame().to_numpy().T
    names = {"device": [f"{LONG}{i}" for i in range(devices)], "flight": [f"f{i}" for i in range(flights)],
             "receiver": [f"u{i}" for i in range(receivers)]}
    level_db = np.random.default_rng(0).normal(0, 2, index.shape[1])
    level_db[::7] = np.nan
    links = SimpleNamespace(level_db=level_db, names=names, flight_names=names["flight"], receiver_names=names["receiver"],
                            variables=dict(zip(("device", "flight", "receiver"), index)))
    return SimpleNamespace(links=links, before_db=np.zeros(len(level_db)))


def group(statistic="level", ranges=(), **members):
    family = next(iter(members)) if len(members) == 1 else " x ".join(members)
    return {"family": family, "members": members, "statistic": statistic, "ranges": dict(ranges)}


def frames(figure):
    return [sum(isinstance(patch, Rectangle) and not patch.get_fill() for patch in ax.patches) for ax in figure.axes
            if ax.images]


def test_cells_are_those_of_a_pivot_table():
    data = campaign(5, 4, 2)
    found = pivot(data.links, data.links.level_db, ("device", "flight"), [])
    table = pd.DataFrame(data.links.variables).assign(residual_db=data.links.level_db).dropna()
    expected = table.pivot_table(index="device", columns="flight", values="residual_db", aggfunc="median").to_numpy()
    np.testing.assert_allclose(found.median_db, expected)
    assert found.names[0] == data.links.names["device"] and found.left_out == {"device": 0, "flight": 0}


@pytest.mark.parametrize(("anomaly", "expected"), (
    (group(device=[LONG + "1"]), [1, 0, 0, 0]), (group("scatter", flight=["f2"]), [0, 1, 0, 1]),
    (group(device=[LONG + "1"], flight=["f0", "f2"]), [2, 0, 0, 0]), (group(device=[LONG + "1"], receiver=["u0"]), [0, 0, 0, 0]),
    (group(receiver=["u0"], flight=["f1"], ranges=[("time_s", (0.0, 9.0))]), [0, 0, 1, 0]), (group(), [0, 0, 0, 0]),
    (group(device=[LONG + "1"], receiver=["u0"]) | {"family": "device"}, [1, 0, 0, 0])))  # they never part
def test_what_stands_out_is_framed_where_its_ends_are(anomaly, expected):
    assert frames(groups_figure(campaign(3, 4, 2), {"anomalies": [anomaly]})) == expected


def test_of_many_members_those_that_stand_out_are_shown_and_long_names_stay_apart():
    data = campaign(50, 1, 1)
    figure = groups_figure(data, {"anomalies": [group(device=[LONG + "49"])]})
    assert frames(figure) == [1, 0] and "10 devices not shown" in figure.axes[0].get_xlabel()
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert len(names) == len(set(names)) == 40 and all(len(name) <= 22 for name in names)


def test_with_one_flight_receivers_take_its_place():
    figure = groups_figure(campaign(3, 1, 3), {"anomalies": [group(device=[LONG + "1"], receiver=["u0"])]})
    assert frames(figure) == [1, 0] and figure.axes[0].get_xlabel() == "receiver"
