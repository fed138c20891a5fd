"""Flower's ServerApp and ClientApp: strategies, what is in the messages, and real processes on the loopback.

Flower pins older versions of what radiotwin uses: where it is not installed these tests are skipped, and
`make test-flower` runs them in an environment of their own.
"""

import os
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("flwr", reason="Flower is not installed; `make test-flower` has an environment with it")

from flwr.app import ArrayRecord, ConfigRecord, Context, Message, MetricRecord, RecordDict  # noqa: E402
from flwr.supercore.inflatable.inflatable_object import get_all_nested_objects  # noqa: E402
from flwr.supercore.task_identity import TaskIdentity  # noqa: E402

import marl.replicas  # noqa: E402
from marl.checkpoint import load_checkpoint  # noqa: E402
from marl.fedqmix import flower_client  # noqa: E402
from marl.fedqmix.client import Party  # noqa: E402
from marl.fedqmix.flower_records import arrays_of  # noqa: E402
from marl.fedqmix.flower_run import Federation  # noqa: E402
from marl.fedqmix.flower_server import Record, make_strategy  # noqa: E402
from marl.fedqmix.session import federate  # noqa: E402
from marl.fedqmix.settings import FederationSettings  # noqa: E402
from marl.fedqmix.shared import Shared, initial_weights, write_app  # noqa: E402
from marl.settings import PRESETS, RunSettings  # noqa: E402

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
    monkeypatch.delenv(flower_client.PARTIES, raising=False)
    node = {"scene": str(small_scene.folder), "out": str(tmp_path / "party"), "number": 0, "truth": "segmented"}
    return Context(run_id=5, node_id=7, node_config=node, state=RecordDict(), run_config=flat(shared))


def test_nothing_but_weights_and_counts_leaves_a_party(shared, context, small_scene):
    trained = flower_client.app(asked(shared), context)
    like = initial_weights(shared)
    assert trained.has_content() and set(trained.content) == {"arrays", "metrics"}
    assert dict(trained.content["metrics"]) == {"num-examples": 8}
    arrays = trained.content["arrays"]
    assert {name: (array.shape, array.dtype) for name, array in arrays.items()} == {
        name: (array.shape, "float64") for name, array in like.items()}
    evaluated = flower_client.app(asked(shared, "evaluate"), context)
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
    reply = flower_client.app(asked(shared), context)
    assert reply.has_error() and reply.error.reason == flower_client.ERROR_REASON
    assert "BadInput" in capfd.readouterr().err  # the party itself is told
