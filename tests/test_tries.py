"""What people try first in Python, through public names alone: it works, or says what to pass."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest

import radiotwin as rt
from radiotwin.io.forms import Origin
from tests.worlds import placed

ORIGIN = Origin(latitude_deg=47.5, longitude_deg=8.7)
METRES_A_DEGREE = np.array([111_170.0, 75_320.0])  # of latitude and longitude, at 47.5 degrees
LEVEL_DBM, EXPONENT, SD_DB = -60.0, 2.7, 2.0  # of the made links: at 100 m


@pytest.fixture(scope="module")
def folder(small_scene, tmp_path_factory):
    """A scene folder with an origin, and a log of two flights and four masts beside it."""
    folder = tmp_path_factory.mktemp("tries")
    placed(small_scene, devices=[]).save(folder / "town")
    rng = np.random.default_rng(0)
    masts_m = np.array([[110.0, 90.0], [200.0, 220.0], [240.0, 70.0], [50.0, 240.0]])
    masts = pd.DataFrame({"device": list("ABCD"), **degrees(masts_m), "height_m": 75.0})
    east_m, north_m = rng.uniform(10, 290, (2, 400))
    mast = np.arange(400) % 4
    distance_m = np.sqrt((east_m - masts_m[mast, 0]) ** 2 + (north_m - masts_m[mast, 1]) ** 2 + 25.0**2)
    level_dbm = LEVEL_DBM - 10 * EXPONENT * np.log10(distance_m / 100) + rng.normal(0, SD_DB, 400)
    log = pd.DataFrame({"flight": np.where(np.arange(400) < 200, "f1", "f2"), **degrees(np.c_[east_m, north_m]),
                        "height_m": 50.0, "device": masts["device"].to_numpy()[mast], "rssi_dbm": level_dbm})
    return folder, log, masts


def degrees(place_m):
    latitude, longitude = (place_m[:, ::-1] / METRES_A_DEGREE + [47.5, 8.7]).T
    return {"latitude": latitude, "longitude": longitude}


@pytest.fixture(scope="module")
def log(folder):
    return folder[1]


@pytest.fixture(scope="module")
def masts(folder):
    return folder[2]


@pytest.fixture(scope="module")
def town(folder):
    return folder[0] / "town"


@pytest.fixture(scope="module")
def twin(town, log, masts):
    return rt.fit_twin(rt.Measurements(log, masts, ORIGIN), town, "log_distance")


def test_measurements_are_made_of_a_data_frame(log, masts):
    made = rt.Measurements(log, masts)
    assert len(made) == 400 and made.flights == ["f1", "f2"] and made.is_anchor.all()
    assert made.origin.latitude_deg == pytest.approx(log["latitude"].median(), abs=1e-6)
    again = made.in_frame(ORIGIN).receiver_m[:3, 1]
    assert again == pytest.approx((log["latitude"][:3] - 47.5) * METRES_A_DEGREE[0], abs=0.5)
    assert not rt.Measurements(log).is_anchor.any(), "without devices, all are to be found"
    unnamed = rt.Measurements(log.drop(columns="flight"), masts)
    assert unnamed.flights == ["1"] and set(unnamed.table["receiver"]) == {"1"}
    local = made.table.drop(columns=["flight", "receiver"])
    assert np.array_equal(rt.Measurements(local, made.devices).receiver_m, made.receiver_m)


def test_a_twin_is_fitted_to_files_by_their_names(town, log, masts, tmp_path, twin):
    rt.Measurements(log, masts, ORIGIN).save(tmp_path / "m.csv")
    fitted = rt.fit_twin(str(tmp_path / "m.csv"), str(town), "log_distance")
    assert fitted.params["value"].to_numpy() == pytest.approx(twin.params["value"].to_numpy(), rel=1e-6)


@pytest.mark.parametrize("where", [
    {"latitude": 47.5, "longitude": 8.7, "height_m": 50.0}, {"x_m": 0.0, "y_m": 0.0, "height_m": 50.0},
    {"x_m": 0.0, "y_m": 0.0, "above_ground_m": 50.0}, {"lat": 47.5, "lon": 8.7, "z_m": 50.0}])
def test_a_twin_predicts_at_a_place(twin, where):
    expected_dbm = LEVEL_DBM - 27 * np.log10(np.sqrt(240.0**2 + 70.0**2 + 25.0**2) / 100)
    at = twin.predict(**where, device="C")
    assert list(at["device"]) == ["C"] and at["mean_db"].item() == pytest.approx(expected_dbm, abs=0.7)
    assert at["sd_db"].item() == pytest.approx(SD_DB, rel=0.15)
    assert (at["high_db"] - at["low_db"]).item() == pytest.approx(2 * 1.66 * SD_DB, rel=0.15)
    assert list(twin.predict(**where)["device"]) == list("ABCD"), "without a name, all devices"
    narrow = twin.predict(**where, device="C", interval=0.5)
    assert narrow["low_db"].item() > at["low_db"].item()


def test_a_twin_predicts_arrays_and_data_frames(twin, log, masts):
    rows = twin.predict(x_m=np.arange(3.0), y_m=0.0, height_m=50.0, device=["A", "B", "A"])
    assert list(rows["device"]) == ["A", "B", "A"] and rows["x_m"].tolist() == [0, 1, 2]
    array = twin.predict(np.array([[0, 0, 50.0], [1, 0, 50.0]]), device=["A", "B"])
    assert np.array_equal(array["mean_db"], rows["mean_db"][:2])
    some = log[log["device"] == "B"].sample(20, random_state=0)
    found = twin.predict(some)
    assert found.index.equals(some.index) and (found["device"] == "B").all()
    assert np.std(some["rssi_dbm"] - found["mean_db"]) < 1.5 * SD_DB
    inside = some["rssi_dbm"].between(found["low_db"], found["high_db"])
    assert inside.sum() >= 15
    measured = twin.predict(rt.Measurements(log, masts))
    assert measured["mean_db"].to_numpy() == pytest.approx(twin.predict(log)["mean_db"].to_numpy(), abs=0.01)
    assert len(twin.predict(pd.DataFrame({"x_m": [0.0, 5.0], "y_m": 0.0}), height_m=1.5)) == 2 * 4


def test_params_are_the_fitted_law_with_units_and_intervals(twin, tmp_path):
    params = twin.params.set_index(["links", "parameter"])
    truth = {"level at 100 m": LEVEL_DBM, "path-loss exponent": EXPONENT, "sd": SD_DB}
    for name, value in truth.items():
        row = params.loc["all", name]
        middle, reach = (row["low"] + row["high"]) / 2, row["high"] - row["low"]
        assert abs(middle - value) < 1.5 * reach and reach < 0.5 * abs(value), name
    assert params["unit"].tolist() == ["dBm", "", "dB"]
    twin.save(tmp_path / "twin")
    assert rt.Twin.load(tmp_path / "twin").params.equals(twin.params)


def test_a_loaded_twin_predicts_with_the_scene_that_it_is_given(town, log, masts, tmp_path):
    fitted = rt.fit_twin(rt.Measurements(log, masts), town, "segmented_log_distance")
    fitted.save(tmp_path / "twin")
    at = {"x_m": 0.0, "y_m": 0.0, "height_m": 50.0, "device": "A"}
    with pytest.raises(rt.BadInput, match="made with a 3D map .* in Python as scene="):
        rt.Twin.load(tmp_path / "twin").predict(**at)
    expected = fitted.predict(**at)
    assert rt.Twin.load(tmp_path / "twin", town).predict(**at).equals(expected)
    assert rt.Twin.load(tmp_path / "twin").predict(**at, scene=str(town)).equals(expected)
    assert len(fitted.radio_map()) == 4


def test_scenes_and_twins_list_their_devices(small_scene, twin, masts):
    declared = small_scene.devices
    assert list(declared) == ["device", "role", "x_m", "y_m", "z_m"] and len(declared) == 7
    where = twin.positions.set_index("device")
    assert where.loc["C", "latitude_deg"] == pytest.approx(masts["latitude"][2], abs=1e-7)
    assert where["radius_m"].tolist() == [0.0] * 4 and where["located"].all()


def test_a_loop_lists_what_stands_out_and_why(log, masts):
    quiet = log.assign(rssi_dbm=log["rssi_dbm"] - 8.0 * (log["device"] == "B"))
    loop = rt.close_loop(rt.Measurements(quiet, masts))
    assert "B" in set(loop.anomalies["devices"]) and (loop.anomalies["probability"] > 0.5).all()
    of_device = loop.anomalies[loop.anomalies["devices"] == "B"].iloc[0]
    assert of_device["low"] < -8.0 < of_device["high"] and of_device["unit"] == "dB"
    assert list(loop.effects) == ["effect", "rank", "probability", "parameter", "value", "low", "high", "unit",
                                  "determined"]
    assert len(loop.effects) >= 1 or loop.verdict != "effect"


def test_a_twin_is_an_estimator_of_scikit_learn(town, log, masts):
    sklearn = pytest.importorskip("sklearn")
    from sklearn.model_selection import GridSearchCV, cross_val_score

    estimator = rt.TwinRegressor(str(town), masts, "log_distance")
    again = sklearn.clone(estimator)
    assert again.get_params()["model"] == "log_distance" and not hasattr(again, "twin_")
    scores = cross_val_score(estimator, log, log["rssi_dbm"], groups=log["flight"], cv=3)
    assert (scores > 0.6).all()
    search = GridSearchCV(estimator, {"model": ["log_distance", "segmented_log_distance"]}, cv=2)
    assert search.fit(log, log["rssi_dbm"]).best_params_["model"] in {"log_distance", "segmented_log_distance"}
    assert estimator.fit(log).score(log, log["rssi_dbm"]) == pytest.approx(scores.mean(), abs=0.15)
    code = "import sys, radiotwin as rt; rt.TwinRegressor(); print('sklearn' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"


def wrong_uses(twin, log, masts, town):
    at, made = {"x_m": 0.0, "y_m": 0.0}, rt.Measurements(log, masts)
    return {
        "say where": lambda: twin.predict(),
        "the height is missing": lambda: twin.predict(**at),
        "end its name in it: x_m or x_ft": lambda: twin.predict(x=0.0, y=0.0, height_m=1.5),
        "'Q' is not in the twin; it has A, B, C, D": lambda: twin.predict(**at, height_m=1.5, device="Q"),
        "different lengths": lambda: twin.predict(x_m=[1, 2], y_m=[1, 2, 3], height_m=1.5),
        "not list": lambda: twin.predict([0.0, 0.0, 1.5]),
        "is no latitude": lambda: twin.predict(latitude=147.5, longitude=8.7, height_m=1.5),
        "no probability between 0 and 1": lambda: twin.predict(**at, height_m=1.5, interval=90),
        "a scene is needed, not int": lambda: twin.predict(**at, height_m=1.5, scene=5),
        "twin.predict takes their names": lambda: twin.links(np.zeros((1, 3)), np.array(["A"])),
        "Measurements.load.path. reads a file": lambda: rt.Measurements("m.csv"),
        "Measurements.frame. takes a data frame": lambda: rt.Measurements.load(log),
        "exactly one of the columns gain_db and rssi_dbm": lambda: rt.Measurements(log.drop(columns="rssi_dbm")),
        "column 'device' is missing": lambda: rt.Measurements(log.drop(columns="device")),
        "there is no position": lambda: rt.Measurements(log[["device", "rssi_dbm"]]),
        "row 399, column rssi_dbm: 'loud' is not a number": lambda: rt.Measurements(
            log.assign(rssi_dbm=[*log["rssi_dbm"][:-1], "loud"]), masts),
        "device 'D' has links and is not among the devices": lambda: rt.Measurements(log, masts[:3]),
        "select takes a mask of 400": lambda: made.select("f1"),
        "no anchor": lambda: rt.fit_twin(log, town),
        "measurements are needed, not dict": lambda: rt.fit_twin({}, town),
        "is not a folder": lambda: rt.fit_twin(made, "nowhere"),
        "channel model 'magic' is unknown": lambda: rt.fit_twin(made, town, "magic"),
        "nowhere.csv does not exist": lambda: rt.close_loop("nowhere.csv"),
        "a twin needs a 3D map": lambda: rt.TwinRegressor().fit(log, log["rssi_dbm"]),
        "is not fitted": lambda: rt.TwinRegressor(town).predict(log),
        "has no parameter 'depth'": lambda: rt.TwinRegressor().set_params(depth=3),
    }


def test_a_wrong_use_says_what_to_pass(twin, log, masts, town):
    for pattern, use in wrong_uses(twin, log, masts, town).items():
        with pytest.raises(rt.BadInput, match=pattern):
            use()
