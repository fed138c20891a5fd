"""Flower's ServerApp and ClientApp: strategies, what is in the messages, and real processes on the loopback.

Flower pins older versions of what radiotwin uses: where it is not installed these tests are skipped, and
`make test-flower` runs them in an environment of their own.
"""

import json
import os
import re
import signal
import socket
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("flwr", reason="Flower is not installed; `make test-flower` has an environment with it")

from flwr.app import ConfigRecord, Context, Message, MetricRecord, RecordDict  # noqa: E402
from flwr.supercore.inflatable.inflatable_object import get_all_nested_objects  # noqa: E402
from flwr.supercore.task_identity import TaskIdentity  # noqa: E402

import marl.replicas  # noqa: E402
from marl.checkpoint import load_checkpoint  # noqa: E402
from marl.fedqmix import flower_app  # noqa: E402
from marl.fedqmix.client import Party  # noqa: E402
from marl.fedqmix.federation import average, initial_weights  # noqa: E402
from marl.fedqmix.flower_app import Record, arrays_of, make_strategy  # noqa: E402
from marl.fedqmix.flower_run import (  # noqa: E402
    Federation,
    Processes,
    free_port,
    make_node_key,  # noqa: E402
)
from marl.fedqmix.session import FederatedSession, federate  # noqa: E402
from marl.fedqmix.settings import (  # noqa: E402
    EngineSettings,
    FederationSettings,
    Shared,
    write_app,
)
from marl.settings import PRESETS, RunSettings  # noqa: E402
from radiotwin.errors import RunFailed  # noqa: E402

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
    return Shared(RUN, LEARNER, FederationSettings(), 3, len(config.uavs), len(config.devices))


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


def drawn(like, seed):
    rng = np.random.default_rng(seed)
    return {name: np.abs(rng.normal(size=array.shape)).astype(np.float32) for name, array in like.items()}


def strategy_of(shared, tmp_path, strategy="fedavg", **changes):
    federation = FederationSettings(strategy=strategy, **changes)
    like = initial_weights(shared)
    return make_strategy(replace(shared, federation=federation), like, [40, 40, 40], Record(tmp_path)), like


def mean_of(replies, strategy, number=1):
    arrays, _ = strategy.aggregate_train(number, replies)
    return None if arrays is None else {name: array.numpy() for name, array in arrays.items()}


def test_the_mean_is_weighted_by_episodes(shared, tmp_path):
    strategy, like = strategy_of(shared, tmp_path)
    parties = [drawn(like, seed) for seed in range(3)]
    mean = mean_of([answer(weights, count) for weights, count in zip(parties, (10, 30, 40))], strategy)
    for name in like:
        exact = sum(weights[name].astype(np.longdouble) * count
                    for weights, count in zip(parties, (10, 30, 40))) / 80
        np.testing.assert_allclose(mean[name], exact.astype(float), rtol=1e-12)
    assert (strategy.record.heard, strategy.record.episodes) == (3, 80)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_the_mean_is_that_of_one_process_to_the_bit_where_weights_cancel(shared, tmp_path, order):
    strategy, like = strategy_of(shared, tmp_path)
    parties = [drawn(like, seed) for seed in range(2)]
    parties.append({name: (value * np.float32(1 - 1e-5) - parties[0][name] - parties[1][name]).astype(np.float32)
                    for name, value in parties[0].items()})
    parties = [{name: np.abs(value) if name.startswith("square.") else value for name, value in each.items()}
               for each in parties]
    mean, expected = mean_of([answer(parties[i], 40) for i in order], strategy), average(parties)
    for name in like:
        np.testing.assert_array_equal(mean[name].astype(np.float32), expected[name])


def test_a_round_goes_on_with_two_of_three_and_not_with_one(shared, tmp_path):
    strategy, like = strategy_of(shared, tmp_path)
    parties = [drawn(like, seed) for seed in range(2)]
    mean = mean_of([answer(weights, 8) for weights in parties], strategy)
    for name in like:
        np.testing.assert_allclose(mean[name], (parties[0][name].astype(float) + parties[1][name]) / 2, rtol=1e-12)
    assert mean_of([answer(parties[0], 8)], strategy) is None
    assert mean_of([], strategy) is None


@pytest.mark.parametrize("damage", [
    lambda w: w["agent.head.bias"].fill(np.nan), lambda w: w.pop("agent.head.bias"),
    lambda w: w.update({"agent.head.bias": np.zeros((2, 3), np.float32)}), lambda w: w["square.0"].fill(-1)])
def test_replies_that_are_no_weights_are_left_out(damage, shared, tmp_path):
    strategy, like = strategy_of(shared, tmp_path)
    parties = [drawn(like, seed) for seed in range(3)]
    damage(parties[1])
    mean = mean_of([answer(weights, 8) for weights in parties], strategy)
    for name in like:
        np.testing.assert_allclose(mean[name], (parties[0][name].astype(float) + parties[2][name]) / 2, rtol=1e-12)


@pytest.mark.parametrize("episodes", [0, -5, 41, 8.0])
def test_a_count_that_nobody_can_have_is_left_out(episodes, shared, tmp_path):
    strategy, like = strategy_of(shared, tmp_path)
    assert mean_of([answer(drawn(like, 0), 8), answer(drawn(like, 1), episodes)], strategy) is None


def test_momentum_is_that_of_the_paper(shared, tmp_path):
    # Hsu, Qi and Brown 2019: v <- beta v + (w - mean), w <- w - v.
    shared = replace(shared, learner=shared.learner.model_copy(update={"federate_all": False}))
    strategy, like = strategy_of(shared, tmp_path, "fedavgm", server_momentum=0.7)
    strategy.configure_train(1, arrays_of(like), ConfigRecord(), Nodes())
    weights = {name: array.astype(float) for name, array in like.items()}
    velocity = {name: np.zeros(array.shape) for name, array in like.items()}
    for number in (1, 2, 3):
        parties = [drawn(like, 10 * number + seed) for seed in range(2)]
        got = mean_of([answer(each, 8) for each in parties], strategy, number)
        for name in like:
            mean = (parties[0][name].astype(float) + parties[1][name]) / 2
            velocity[name] = 0.7 * velocity[name] + weights[name] - mean
            weights[name] = weights[name] - velocity[name]
            np.testing.assert_allclose(got[name], weights[name], rtol=1e-9, atol=1e-12)


class Nodes:
    """A grid with two nodes."""

    def get_node_ids(self):
        return [7, 8]


def test_fedprox_sends_its_weight_and_parties_read_the_same(shared, tmp_path):
    strategy, like = strategy_of(shared, tmp_path, "fedprox", proximal_mu=0.25)
    [message, _] = strategy.configure_train(1, arrays_of(like), ConfigRecord(), Nodes())
    assert message.content["config"]["proximal-mu"] == 0.25
    given = replace(shared, federation=FederationSettings(strategy="fedprox", proximal_mu=0.25))
    assert Shared.of(flat(given)).proximal_mu == 0.25 and shared.proximal_mu == 0


@pytest.fixture
def context(small_scene, shared, tmp_path, monkeypatch):
    monkeypatch.setattr(marl.replicas, "usable_cores", lambda: 1)
    monkeypatch.delenv(flower_app.PARTIES, raising=False)
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


def is_open(port):
    with socket.socket() as caller:
        return caller.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def parties(small_scene, tmp_path):
    return [Party(small_scene.folder, tmp_path / "parties" / str(number), number, "segmented") for number in range(3)]


def run_federation(shared, parties, tmp_path, simulation, on_progress=lambda rounds: None, made=Federation):
    out, home = tmp_path / "out", tmp_path / "home"
    home.mkdir()
    write_app(shared, out / "app")
    federation = made(parties, out, home, simulation)
    try:
        federation.open()
        federation.watch(federation.run(out / "app"), on_progress)
    finally:
        federation.close()
    assert not left_over(tmp_path)
    assert not any(map(is_open, federation.ports))
    return out


def means_of(out):
    return [load_checkpoint(path)["weights"] for path in sorted((out / "weights").iterdir())]


def same_means(out, shared, parties):
    """Whether every mean is that of one process, to 1e-6."""
    expected, got = federate(shared, parties, lambda count: None), means_of(out)
    assert len(got) == len(expected)
    for a, b in zip(got, expected):
        for name in b:
            np.testing.assert_allclose(a[name], b[name], rtol=0, atol=1e-6)
    assert any((expected[0][name] != expected[-1][name]).any() for name in expected[0])


@pytest.mark.slow
@pytest.mark.parametrize("simulation", [False, True])
def test_flower_makes_the_means_of_one_process(simulation, shared, parties, tmp_path, capsys):
    out = tmp_path / "out"
    engine = EngineSettings(federation="flower" if simulation else "flower-processes",
                            party_scenes=",".join(str(party.scene) for party in parties))
    run = shared.run.model_copy(update={"truth": "segmented"})
    FederatedSession(run, shared.learner, FederationSettings(), engine, out).execute()
    assert not left_over(tmp_path)
    ports = re.findall(r"127\.0\.0\.1:(\d+)", "".join(path.read_text() for path in (out / "logs").iterdir()))
    assert len(set(ports)) >= (1 if simulation else 4) and not any(is_open(int(port)) for port in ports)
    same_means(out, shared, parties)
    assert pd.read_csv(out / "rounds.csv")["parties"].tolist() == [3, 3]
    assert len(list(out.glob("parties/*/run-*/metrics.csv"))) == 3 and (out / "curve.png").exists()
    assert "in its truth" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_a_party_that_is_killed_comes_back(shared, parties, tmp_path):
    # Rounds go on with two of three; Flower takes the third back a minute after its last heartbeat.
    run = shared.run.model_copy(update={"episodes": 48})
    shared = replace(shared, run=run, learner=shared.learner.model_copy(update={"federate_every": 4}))
    federations, killed = [], []

    class Watched(Federation):
        def watch(self, *given):
            federations.append(self)
            super().watch(*given)

    def on_progress(rounds):
        if not killed:
            federations[0].processes.kill("supernode-1")
            killed.append(rounds)

    out = run_federation(shared, parties, tmp_path, False, on_progress, Watched)
    heard = pd.read_csv(out / "rounds.csv")["parties"].tolist()
    assert len(heard) == 12 and heard[0] == 3 and heard[-1] == 3 and 2 in heard and min(heard) >= 2
    done = json.loads((out / "done.json").read_text())
    assert done == {"rounds": 12, "evaluated": 3}
    [table] = [pd.read_csv(path) for path in parties[1].folder.glob("run-[0-9]*/metrics.csv")]
    assert 4 <= table["simulated_episodes"].iloc[-1] < 48


def test_what_a_process_that_ended_has_left_is_ended_too(tmp_path):
    """As a SuperNode that was refused: what it had started looks only now and then whether it is still there."""
    processes = Processes(tmp_path, tmp_path, {"MARK_OF_TEST": str(tmp_path)})
    processes.start("short", ["sh", "-c", "sleep 300 & sleep 300 & exit 3"])
    end = time.monotonic() + 20
    while processes.is_running("short") and time.monotonic() < end:
        time.sleep(0.05)
    assert len(left_over(tmp_path)) == 2
    processes.close()
    assert not left_over(tmp_path)


@pytest.mark.slow
def test_strangers_are_not_let_in(shared, parties, tmp_path):
    out, home = tmp_path / "out", tmp_path / "home"
    home.mkdir()
    federation = Federation(parties[:1], out, home, simulation=False)
    try:
        federation.open()
        link = f"127.0.0.1:{federation.ports[0]}"
        make_node_key(home / "stranger")
        for name, options in (
                ("unregistered", ["--root-certificates", str(home / "ca.crt"), "--auth-supernode-private-key",
                                  str(home / "stranger")]),
                ("nameless", ["--root-certificates", str(home / "ca.crt")]),
                ("other-authority", ["--max-wait-time", "1", "--auth-supernode-private-key", str(home / "node-0")]),
                ("plain", ["--max-wait-time", "1", "--insecure"])):
            federation.processes.start(name, ["flower-supernode", "--superlink", link, "--port", str(free_port()),
                                              *options])
            end = time.monotonic() + 120
            while federation.processes.is_running(name) and time.monotonic() < end:
                time.sleep(0.5)
            assert not federation.processes.is_running(name), federation.processes.end_of_log(name)
            assert "SuperNode ID" not in federation.processes.end_of_log(name)
        assert federation.processes.is_running("supernode-0")
    finally:
        federation.close()
    assert not left_over(tmp_path)


def test_a_command_that_fails_ends_with_its_message(shared, parties, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    federation = Federation(parties, tmp_path / "out", home, simulation=False)
    with pytest.raises(RunFailed, match="flwr run"):
        federation.run(tmp_path / "no-app")
    federation.close()
