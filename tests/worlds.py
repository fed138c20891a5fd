"""Worlds that tests of several packages share: open ground, by plain formulas of their own, and a traced city."""

from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import trimesh

from radiotwin.closeloop.predict.baselines import grow_trees
from radiotwin.closeloop.predict.predictor import CombinedPrediction
from radiotwin.closeloop.predict.weights import Combination
from radiotwin.effects.registry import catalogue
from radiotwin.io.forms import Origin
from radiotwin.links.links import Columns, Ends, Flown, Links, World
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.maps.survey import fly_survey
from radiotwin.scene import Scene
from radiotwin.scene.citymap import CityMap

FLIGHTS, SLOTS, RECEIVERS, DEVICES = 6, 60, 2, 5
RBM = Path(__file__).parents[1] / "scenes" / "rbm"
IN_A_NARROW_STREET = "d4"


def fly(seed, noise_db=2.0, limit_db=-110.0, flights=FLIGHTS, slots=SLOTS, devices=DEVICES):
    """Fly over open ground: arrays of links, to be changed, with gain = -35 - 26 log10(d) + noise."""
    rng = np.random.default_rng(seed)
    device_m = np.column_stack([rng.uniform(0, 500, (devices, 2)), np.full(devices, 1.5)])
    rows = []
    for flight in range(flights):
        for receiver in range(RECEIVERS):
            position_m, heading = rng.uniform(100, 400, 2), rng.uniform(0, 2 * np.pi)
            for slot in range(slots):
                heading += rng.normal(0, 0.25)
                if np.abs(position_m - 250).max() > 240:
                    heading = np.arctan2(*(250 - position_m))
                position_m = position_m + 10 * np.array([np.sin(heading), np.cos(heading)])
                rows += [(flight, receiver, device, 200.0 * flight + slot, slot, *position_m, 50.0 + 10 * receiver,
                          np.degrees(heading) % 360) for device in range(devices)]
    flight, receiver, device, time_s, slot, x, y, z, heading_deg = np.array(rows).T
    flight, receiver, device = (value.astype(int) for value in (flight, receiver, device))
    receiver_m = np.column_stack([x, y, z])
    offset_m = receiver_m - device_m[device]
    distance_m = np.linalg.norm(offset_m, axis=1)
    gain_db = -35 - 26 * np.log10(distance_m) + rng.normal(0, noise_db, len(rows))
    return SimpleNamespace(
        flight=flight, receiver=receiver, device=device, time_s=time_s, slot=slot, receiver_m=receiver_m,
        device_m=device_m, heading_deg=heading_deg, offset_m=offset_m, distance_m=distance_m, gain_db=gain_db,
        limit_db=limit_db)


def measured(world, **columns):
    """Return the measurements that a user would have of it."""
    gain_db = np.where(world.gain_db < world.limit_db, np.nan, world.gain_db)
    table = pd.DataFrame({
        "time_s": world.time_s, "flight": [f"f{i}" for i in world.flight],
        "receiver": [f"r{i}" for i in world.receiver],
        **{f"receiver_{axis}_m": world.receiver_m[:, i] for i, axis in enumerate("xyz")},
        "device": [f"d{i}" for i in world.device], "gain_db": gain_db, "heading_deg": world.heading_deg} | columns)
    devices = pd.DataFrame({"device": [f"d{i}" for i in range(len(world.device_m))], "x_m": world.device_m[:, 0],
                            "y_m": world.device_m[:, 1], "z_m": world.device_m[:, 2], "role": "anchor",
                            "frequency_hz": 2.4e9})
    return Measurements(table, devices)


def placed(scene, **changes):
    """Return a scene with an origin, and other changes of what it declares."""
    origin = Origin(latitude_deg=47.5, longitude_deg=8.7)
    return replace(scene, config=scene.config.model_copy(update={"origin": origin} | changes))


def thinned(flown, step):
    """Return every moment of that number of some measurements."""
    return flown.select(np.unique(flown.table["time_s"], return_inverse=True)[1] % step == 0)


@pytest.fixture(scope="session")
def open_ground():
    """`fly(seed)` makes a world over open ground, `measured(world)` its measurements."""
    return SimpleNamespace(fly=fly, measured=measured)


@contextmanager
def shortened():
    """Half of the time goes into what predicts best and what would have been seen, which have tests of their own."""
    def alone(model, *_):
        mean_db = model.held_out_mean_db
        return CombinedPrediction(mean_db, mean_db, np.full(len(mean_db), 0.5),
                                  Combination({"named": (1.0, 1.0)}, 50.0, (1.0, 1.0)), {"log_distance": mean_db})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("radiotwin.closeloop.run.combined_prediction", alone)
        patch.setattr("radiotwin.closeloop.run.detectable", lambda *_: [])
        yield


@pytest.fixture
def short_report():
    with shortened():
        yield


@contextmanager
def quickened():
    """A report as ever, from forests of five trees and a few patterns: they take two thirds of the time of a small loop."""
    def grown(kind, features, target, seed, *_):
        return grow_trees(kind, features, target, seed, 5)
    with pytest.MonkeyPatch.context() as patch:
        for module in ("baselines", "predictor"):
            patch.setattr(f"radiotwin.closeloop.predict.{module}.grow_trees", grown)
        for most in ("MAX_MEMBERS", "MAX_PLACES"):
            patch.setattr(f"radiotwin.effects.patterns.{most}", 1)
        yield


@pytest.fixture
def quick_report():
    with quickened():
        yield


def leave_effects(patch, *names):
    """Leave some effects in the catalogue of a loop: to look for all of them takes seconds."""
    few = [each for each in catalogue() if each.name in names]
    assert {each.name for each in few} == set(names)
    patch.setattr("radiotwin.closeloop.run.catalogue", lambda: few)


@pytest.fixture
def only_effects(monkeypatch):
    """Function that leaves some effects in the catalogue of a loop, by their names."""
    return partial(leave_effects, monkeypatch)


@pytest.fixture(scope="session")
def narrow_street():
    """RBM, links of its anchors and of one unknown device in a narrow street, and its true position."""
    scene = Scene.load(RBM)
    flown = fly_survey(scene, RadioMap.load(RBM / "truth.nc"), flights=3, pattern="random-waypoint", seed=0,
                       noise_db=1.0)
    flown = thinned(flown, 3)
    devices = flown.devices[(flown.devices["role"] == "anchor") | (flown.devices["device"] == IN_A_NARROW_STREET)]
    links = flown.table[flown.table["device"].isin(devices["device"])]
    position_m = next(np.array([each.x_m, each.y_m]) for each in scene.config.devices
                   if each.device == IN_A_NARROW_STREET)
    return SimpleNamespace(scene=scene, name=IN_A_NARROW_STREET, position_m=position_m, measured=Measurements(
        links.reset_index(drop=True), devices.reset_index(drop=True)))


def synthetic_links(device_m, device, receiver_m, *, level_db=np.nan, limit_db=-np.inf, receiver=0, flight=0,
                    time_s=np.nan, heading_deg=np.nan, frequency_hz=2.4e9, city=None, is_gain=True, **columns):
    """Return n links as they would be made of measurements; a number that is given holds for every link.

    Args:
        device_m: (k, 3) positions of the devices, all declared [m].
        device: (n,) index of each link's device.
        receiver_m: (n, 3) positions of the receivers [m].
        columns: of `Columns`, beside those above.
    """
    device_m, device, receiver_m = np.asarray(device_m, float), np.asarray(device), np.asarray(receiver_m, float)
    given = {"level_db": level_db, "limit_db": limit_db, "time_s": time_s, "heading_deg": heading_deg}
    of_each = {name: np.broadcast_to(np.asarray(value, float), len(device)).copy() for name, value in given.items()}
    index = {name: np.broadcast_to(value, len(device)).copy()
             for name, value in {"receiver": receiver, "flight": flight}.items()}
    columns = Columns(device=device, receiver_m=receiver_m, **of_each, **index, **columns)
    names = {f"{kind}_names": [f"{kind[0]}{i}" for i in range(index[kind].max(initial=0) + 1)] for kind in index}
    ends = Ends(device_names=[f"d{i}" for i in range(len(device_m))], device_m=device_m,
                anchors=frozenset(range(len(device_m))), flown=Flown.of(columns), **names)
    return Links(columns=columns, ends=ends, world=World(frequency_hz=frequency_hz, city=city, is_gain=is_gain))


def city_of_boxes(*bounds_m, ground_m=0.0, **given):
    """Return the map of boxes from (x, y, z) to (x, y, z) [m], on a square ground of that width around the origin."""
    ground = [[[-ground_m / 2, -ground_m / 2, -0.2], [ground_m / 2, ground_m / 2, 0.0]]] if ground_m else []
    mesh = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in (*ground, *bounds_m)])
    return CityMap(mesh.vertices, mesh.faces, **given)


@pytest.fixture
def make_links():
    """Make the links of every receiver position (n, 3) to every device (k, 3): Links of n k links."""
    def make(device_m, receiver_m, **given):
        device_m, receiver_m = np.atleast_2d(device_m).astype(float), np.atleast_2d(receiver_m).astype(float)
        values = {"level_db": 0.0} | given
        return synthetic_links(device_m, np.tile(np.arange(len(device_m)), len(receiver_m)),
                               np.repeat(receiver_m, len(device_m), axis=0), **values)
    return make
