"""Flower's ServerApp and ClientApp: means, what is in the messages, and real processes on the loopback.

Flower pins older versions of what radiotwin uses: where it is not installed these tests are skipped, and
`make test-flower` runs them in an environment of their own.
"""

import os
import signal
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("flwr", reason="Flower is not installed; `make test-flower` has an environment with it")

from flwr.app import ConfigRecord, Context, Error, Message, MetricRecord, RecordDict  # noqa: E402
from flwr.supercore.inflatable.inflatable_object import get_all_nested_objects  # noqa: E402
from flwr.supercore.task_identity import TaskIdentity  # noqa: E402

import marl.replicas  # noqa: E402
from marl.checkpoint import load_checkpoint  # noqa: E402
from marl.fedqmix import flower_app  # noqa: E402
from marl.fedqmix.client import Client, Party  # noqa: E402
from marl.fedqmix.federation import initial_weights  # noqa: E402
from marl.fedqmix.flower_app import arrays_of, usable  # noqa: E402
from marl.fedqmix.session import federate, node_config  # noqa: E402
from marl.fedqmix.settings import Shared, write_app  # noqa: E402
from marl.settings import PRESETS, RunSettings  # noqa: E402
from radiotwin.errors import RunFailed  # noqa: E402
from tests.marl.flower_processes import Processes  # noqa: E402

MAX_S = 1800  # of a test, on a machine that does much else

LEARNER = PRESETS["fast"].model_copy(update={
    "parallel": 4, "batch": 4, "replay": 16, "hidden": 8, "mixing_width": 4, "federate_every": 8,
    "selection_flights": 2, "epsilon_slots": 500})
RUN = RunSettings(twin="truth", real_episodes=1, episodes=16, flights=2, device="cpu")


@pytest.fixture(autouse=True)
def task(monkeypatch):
    """A message has the numbers of the process that makes it."""
    for name, number in (("_task_id", 1), ("_run_id", 5), ("_node_id", 1)):
        monkeypatch.setattr(TaskIdentity, name, number)


@pytest.fixture
def shared(small_scene):
    config = small_scene.config
    return Shared(run=RUN, learner=LEARNER, clients=3, uavs=len(config.uavs), devices=len(config.devices))


def flat(shared):
    config = shared.config()
    return {name: value for name, value in config.items() if not isinstance(value, dict)} | {
        f"{group}.{name}": value for group, values in config.items() if isinstance(values, dict)
        for name, value in values.items()}


def asked(shared, kind="train", number=1):
    """The coordinator's message."""
    content = RecordDict({"arrays": arrays_of(initial_weights(shared)), "config": ConfigRecord({"server-round": number})})
    return Message(content, dst_node_id=7, message_type=kind)


def answer(weights, episodes):
    return Message(RecordDict({"arrays": arrays_of(weights), "metrics": MetricRecord({"num-examples": episodes})}),
                   dst_node_id=1, message_type="train")


class Parties:
    """A grid of nodes with weights and counts of their own in each round; None does not answer, a text is an error."""

    def __init__(self, rounds):
        self.rounds, self.asked = rounds, []

    def get_node_ids(self):
        return list(range(len(self.rounds[0])))

    def send_and_receive(self, messages, timeout):
        messages = list(messages)
        self.asked.append(messages[0])
        if messages[0].metadata.message_type == "evaluate":
            return []
        number = messages[0].content["config"]["server-round"]
        assert len(messages) == len(self.rounds[0])
        return [Message(Error(2, given), reply_to=message) if isinstance(given, str) else answer(*given)
                for given, message in zip(self.rounds[number - 1], messages) if given is not None]


def coordinated(shared, grid, tmp_path):
    """Means of all rounds, from the coordinator's files, and its table."""
    context = Context(run_id=5, node_id=1, node_config={}, state=RecordDict(),
                      run_config=flat(shared) | {"out": str(tmp_path / "out"), "round_timeout_s": 1.0})
    flower_app.main(grid, context)
    return means_of(tmp_path / "out")[1:], pd.read_csv(tmp_path / "out" / "rounds.csv")


def drawn(like, seed):
    rng = np.random.default_rng(seed)
    return {name: np.abs(rng.normal(size=array.shape)).astype(np.float32) for name, array in like.items()}


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_the_mean_is_weighted_by_episodes_whatever_the_order(order, shared, tmp_path):
    """Where weights cancel, too: the mean is exact before it is rounded."""
    like = initial_weights(shared)
    parties = [drawn(like, seed) for seed in range(2)]
    parties.append({name: value if name.startswith("square.") else
                    (value * np.float32(1 - 1e-5) - parties[0][name] - parties[1][name]).astype(np.float32)
                    for name, value in parties[0].items()})
    counts = (3, 5, 8)
    replies = [(parties[i], counts[i]) for i in order]
    [first, _], table = coordinated(shared, Parties([replies, replies]), tmp_path)
    for name in like:
        exact = sum(weights[name].astype(np.longdouble) * count for weights, count in zip(parties, counts)) / 16
        np.testing.assert_array_equal(first[name], exact.astype(np.float32))
    assert table["parties"].tolist() == [3, 3] and table["episodes"].tolist() == [16, 16]


def test_a_round_goes_on_with_two_of_three_and_not_with_one(shared, tmp_path):
    like = initial_weights(shared)
    a, b, c = (drawn(like, seed) for seed in range(3))
    grid = Parties([[(a, 8), "secret", (b, 8)], [None, None, (c, 8)]])
    [first, second], table = coordinated(shared, grid, tmp_path)
    for name in like:
        expected = ((a[name].astype(float) + b[name]) / 2).astype(np.float32)
        np.testing.assert_array_equal(first[name], expected)
        np.testing.assert_array_equal(second[name], expected)
    assert table["parties"].tolist() == [2, 1]
    assert [message.metadata.message_type for message in grid.asked] == ["train", "train", "evaluate"]
    with pytest.raises(RunFailed, match="in no round"):
        coordinated(shared, Parties([[(a, 8), None, None], [None, None, (c, 8)]]), tmp_path / "other")


@pytest.mark.parametrize("damage", [
    lambda w: w["agent.head.bias"].fill(np.nan), lambda w: w.pop("agent.head.bias"),
    lambda w: w.update({"agent.head.bias": np.zeros((2, 3), np.float32)}), lambda w: w["square.0"].fill(-1)])
def test_replies_that_are_no_weights_are_left_out(damage, shared):
    like = initial_weights(shared)
    parties = [drawn(like, seed) for seed in range(3)]
    damage(parties[1])
    left = usable([answer(weights, 8) for weights in parties], like, 40)
    for (got, count), seed in zip(left, (0, 2), strict=True):
        assert count == 8 and all((got[name] == drawn(like, seed)[name]).all() for name in like)


@pytest.mark.parametrize("episodes", [0, -5, 41, 8.0])
def test_a_count_that_nobody_can_have_is_left_out(episodes, shared):
    like = initial_weights(shared)
    assert len(usable([answer(drawn(like, 0), 8), answer(drawn(like, 1), episodes)], like, 40)) == 1


@pytest.fixture
def context(small_scene, shared, tmp_path, monkeypatch):
    monkeypatch.setattr(marl.replicas, "usable_cores", lambda: 1)
    node = {"scene": str(small_scene.folder), "out": str(tmp_path / "party"), "number": 0, "truth": "segmented"}
    return Context(run_id=5, node_id=7, node_config=node, state=RecordDict(), run_config=flat(shared))


def test_nothing_but_weights_and_counts_leaves_a_party(shared, context, small_scene):
    trained = flower_app.client_app(asked(shared), context)
    like = initial_weights(shared)
    assert trained.has_content() and set(trained.content) == {"arrays", "metrics"}
    assert dict(trained.content["metrics"]) == {"num-examples": 8}
    arrays = trained.content["arrays"]
    assert {name: (array.shape, array.dtype) for name, array in arrays.items()} == {
        name: (array.shape, "float64") for name, array in like.items()}
    evaluated = flower_app.client_app(asked(shared, "evaluate"), context)
    assert set(evaluated.content) == {"metrics"} and dict(evaluated.content["metrics"]) == {"num-examples": 2}
    # Nothing stays in Flower's hands between messages either, and no text of the scene is in what is sent.
    assert not context.state
    sent = b"".join(each.deflate() for message in (trained, evaluated) for each in
                    get_all_nested_objects(message).values())
    config = small_scene.config
    for text in [str(small_scene.folder), "scene", *(each.device for each in config.devices),
                 *(each.uav for each in config.uavs)]:
        if len(text) > 4:  # shorter ones may be in the bytes of a weight
            assert text.encode() not in sent


@pytest.mark.parametrize("change", [{"scene": "/nowhere/secret_place"}, {"number": -1}, {"other": "secret_place"}])
def test_an_error_says_nothing_of_what_a_party_holds(change, shared, context, capfd):
    context.node_config.update(change)
    reply = flower_app.client_app(asked(shared), context)
    assert reply.has_error() and reply.error.reason == flower_app.ERROR_REASON
    assert "BadInput" in capfd.readouterr().err  # the party itself is told


@pytest.fixture(autouse=True)
def bounded():
    """End a test that hangs, so that its processes are ended, too."""
    def give_up(number, frame):
        raise TimeoutError("the test takes too long")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(MAX_S)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def left_over(folder):
    """Processes that were started with a path of a folder in their arguments or environment."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            told = (path / "cmdline").read_bytes() + (path / "environ").read_bytes()
            zombie = (path / "stat").read_text().rpartition(")")[2].split()[0] == "Z"
        except OSError:
            continue
        if str(folder).encode() in told and not zombie and int(path.name) != os.getpid():
            found.append(told[:200])
    return found


@pytest.fixture
def parties(small_scene, tmp_path):
    return [Party(small_scene.folder, tmp_path / "parties" / str(number), number, "segmented") for number in range(3)]


def means_of(out):
    return [load_checkpoint(path)["weights"] for path in sorted((out / "weights").iterdir())]


@pytest.mark.slow
@pytest.mark.parametrize("simulation", [False, True])
def test_flower_makes_the_means_of_one_process(simulation, shared, parties, tmp_path):
    """In SuperNodes, and in Flower's simulation engine, which finds its parties in the file beside the app."""
    out = tmp_path / "out"
    write_app(shared.model_copy(update={"out": str(out)}), [node_config(party) for party in parties], tmp_path)
    options = (f"--run-config \"parties='{tmp_path / 'parties.json'}'\" --federation-config 'num-supernodes=3 "
               "client-resources-num-cpus=1'") if simulation else ""
    with Processes(tmp_path / "home", [] if simulation else parties) as processes:
        processes.run(tmp_path / "app", out, options=options)
    assert not left_over(tmp_path)
    alone = [Party(party.scene, tmp_path / "alone" / str(party.number), party.number, "segmented") for party in parties]
    expected, got = federate(shared, [Client(shared.run, LEARNER, party) for party in alone]), means_of(out)
    assert len(got) == len(expected) == 3
    for a, b in zip(got, expected):
        for name in b:
            np.testing.assert_array_equal(a[name], b[name])
    assert any((expected[0][name] != expected[-1][name]).any() for name in expected[0])
    assert pd.read_csv(out / "rounds.csv")["parties"].tolist() == [3, 3]
    assert len(list(tmp_path.glob("parties/*/run-*/metrics.csv"))) == 3


@pytest.mark.slow
def test_a_party_that_is_killed_comes_back(shared, parties, tmp_path):
    # Rounds go on with two of three; Flower takes the third back a minute after its last heartbeat.
    shared = shared.model_copy(update={
        "run": shared.run.model_copy(update={"episodes": 24}), "out": str(tmp_path / "out"),
        "learner": shared.learner.model_copy(update={"federate_every": 4})})
    write_app(shared, [], tmp_path)
    with Processes(tmp_path / "home", parties) as processes:
        processes.run(tmp_path / "app", tmp_path / "out", lambda number: number == 1 and processes.kill("supernode-1"))
    assert not left_over(tmp_path)
    heard = pd.read_csv(tmp_path / "out" / "rounds.csv")["parties"].tolist()
    assert len(heard) == 6 and heard[0] == 3 and heard[-1] == 3 and 2 in heard and min(heard) >= 2
    [table] = [pd.read_csv(path) for path in parties[1].folder.glob("run-[0-9]*/metrics.csv")]
    assert 4 <= table["simulated_episodes"].iloc[-1] < 24
