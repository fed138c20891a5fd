"""A loop that was killed goes on with the parts that it had finished, and ends with the same bytes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from radiotwin.closeloop.output.result_file import make_report
from radiotwin.closeloop.run import close_loop
from radiotwin.effects.registry import catalogue
from radiotwin.runtime import pieces
from radiotwin.runtime.pieces import PieceStore, keep_pieces
from radiotwin.twin.model import fitting
from tests.runtime.execution.jobs import needs_ray, two_workers


class Killed(BaseException):
    """Stands in for SIGKILL: no handler of errors sees it."""


@pytest.fixture
def kill_after(monkeypatch):
    """Return a function: kill the process, as it were, after so many parts."""
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    put = PieceStore.put

    def after(count):
        def put_some(self, *args):
            if self.saved >= count:
                raise Killed
            put(self, *args)
        monkeypatch.setattr(PieceStore, "put", put_some)
    return after


KILLED_AFTER = 15  # pieces of work


@pytest.fixture
def searches(monkeypatch):
    """Count the searches for an effect's parameters."""
    found, search = [], fitting._best_addition
    monkeypatch.setattr(fitting, "_best_addition", lambda *args: found.append(args[1].name) or search(*args))
    return found


@pytest.fixture
def measured(open_ground, only_effects, monkeypatch):
    monkeypatch.setattr("radiotwin.closeloop.run.detectable", lambda *_: [])  # keeps no parts
    only_effects("receiver_gain_offset", "receiver_drift", "device_gain_offset", "faulty_flight")
    world = open_ground.fly(2)
    world.gain_db[world.receiver == 1] += 5.0
    world.gain_db[(world.receiver == 0) & (world.time_s > 530)] -= 6.0
    every = open_ground.measured(world)
    return every.select((world.device < 3) & (world.slot % 2 == 0))


def everything(measured, scene=None, base="log-distance", executor=None):
    loop = close_loop(measured, scene, base, executor=executor)
    return json.dumps(make_report(loop), sort_keys=True), loop.after.held_out_mean_db.tobytes(), \
        loop.before.held_out_mean_db.tobytes()


@pytest.mark.usefixtures("quick_report")
def test_a_killed_loop_goes_on_and_ends_equal_to_the_bit(measured, kill_after, searches):
    whole = everything(measured)
    total = len(searches)
    searches.clear()
    kill_after(KILLED_AFTER)
    with keep_pieces(), pytest.raises(Killed):
        everything(measured)
    before = len(searches)
    searches.clear()
    kill_after(np.inf)
    with keep_pieces() as store:
        assert everything(measured) == whole
    assert 0 < before < total and len(searches) <= total - before + 1
    assert store.earlier >= KILLED_AFTER  # some are asked for twice
    for number, (_, _, path) in enumerate(sorted(store.files())):
        if number % 4 == 0:  # damaged
            path.write_bytes(path.read_bytes()[:-number - 1])
    with keep_pieces() as store:
        assert everything(measured) == whole
    assert store.made and store.earlier


def test_other_data_or_another_seed_take_nothing(measured, kill_after):
    kill_after(5)
    with keep_pieces(), pytest.raises(Killed):
        close_loop(measured, base="log-distance")
    changed = measured.table.copy()
    changed.loc[0, "gain_db"] += 0.25
    kill_after(0)
    for others in ({"measurements": type(measured)(changed, measured.devices)}, {"measurements": measured, "seed": 1}):
        with keep_pieces() as store, pytest.raises(Killed):
            close_loop(**others, base="log-distance")
        assert store.earlier == 0


@pytest.mark.slow
@pytest.mark.parametrize("family", ["nothing", "foliage"])
def test_a_killed_loop_over_a_city_ends_equal_to_the_bit(family, kill_after):
    from tests.undeclared.cases import case

    given = case(family, 1)
    whole = everything(given.measurements, given.scene, "auto")
    for count in (3, 20, 60, np.inf):
        kill_after(count)
        with keep_pieces():
            try:
                assert everything(given.measurements, given.scene, "auto") == whole
            except Killed:
                continue


def test_a_worker_may_take_as_much_memory_as_this_process(monkeypatch):
    asked = []
    executor = SimpleNamespace(is_worth_it=True, run_ahead=lambda job, pieces, parts: asked.append(job.resources))
    for resident in (0, 5 * 2**30):
        monkeypatch.setattr(fitting, "resident_bytes", lambda _, resident=resident: resident)
        with keep_pieces():
            fitting.prepare_additions([], [], executor)
    assert [each.memory_bytes for each in asked] == [fitting.WORKER_BYTES, 5 * 2**30]


@pytest.mark.parametrize("place", [pytest.param("local", marks=pytest.mark.slow),
                                   pytest.param("ray", marks=[pytest.mark.slow, needs_ray])])
def test_workers_of_which_one_is_killed_end_equal_to_the_bit(measured, searches, monkeypatch, place):
    few = [each for each in catalogue() if each.name in ("receiver_gain_offset", "receiver_drift", "device_gain_offset")]
    monkeypatch.setattr("radiotwin.closeloop.run.catalogue", lambda: few)
    monkeypatch.setattr(pieces, "MIN_SECONDS", 0.0)
    whole, total = everything(measured), len(searches)
    searches.clear()
    with keep_pieces() as store, two_workers(place) as (executor, killed):
        assert everything(measured, executor=executor) == whole
    assert killed
    assert store.made and len(searches) < total / 3  # the others were done elsewhere
