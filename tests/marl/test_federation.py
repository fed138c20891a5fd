"""Averaging, and replicas that share no memory."""

import os
import signal

import numpy as np
import pytest

import marl.replicas
from marl.fedqmix.federation import average, weighted_mean
from marl.qmix import QNetworks, Trainer
from marl.replicas import Replicas
from marl.settings import PRESETS
from radiotwin.errors import RunFailed

SETTINGS = PRESETS["fast"].model_copy(update={"parallel": 4, "batch": 4, "replay": 8, "hidden": 8, "mixing_width": 4})


def arguments(mission):
    """Of two trainers."""
    return [(QNetworks, SETTINGS, mission, 100, 0, number) for number in range(2)]


def test_the_average_is_the_exact_mean():
    rng = np.random.default_rng(0)
    replicas = [{"a": rng.normal(size=(3, 2)).astype(np.float32), "b": np.float32(i) * np.ones(4, np.float32)}
                for i in range(3)]
    mean = average(replicas)
    np.testing.assert_array_equal(mean["b"], np.ones(4))
    exact = sum(each["a"].astype(np.longdouble) for each in replicas) / 3
    np.testing.assert_array_equal(mean["a"], exact.astype(np.float32))
    assert mean["a"].dtype == np.float32


def test_a_mean_counts_the_episodes_behind_each_replica():
    replicas = [{"a": np.array([value], np.float32)} for value in (0.0, 4.0)]
    assert weighted_mean(replicas, [3, 1])["a"][0] == 1 and weighted_mean(replicas, [1, 3])["a"][0] == 3
    assert weighted_mean(replicas, [0, 2])["a"][0] == 4


def test_replicas_share_no_memory_after_averaging(city_mission):
    # The published code hands the same tensors to all: its replicas are one from the first averaging on.
    replicas = [Trainer(QNetworks, SETTINGS, city_mission, 100, 0, number) for number in range(3)]
    for replica in replicas:
        replica.train(8)
    assert any((a != b).any() for a, b in zip(replicas[0].weights().values(), replicas[1].weights().values()))
    mean = average([replica.weights() for replica in replicas])
    for replica in replicas:
        replica.set_weights(mean)
    for name, weights in replicas[0].weights().items():
        np.testing.assert_array_equal(weights, mean[name])
        np.testing.assert_array_equal(weights, replicas[2].weights()[name])
    pointers = [{tensor.data_ptr() for tensor in replica.networks.parameters()} for replica in replicas]
    assert not pointers[0] & pointers[1] and not pointers[1] & pointers[2]
    others = [replica.weights() for replica in replicas[1:]]
    replicas[0].train(4)
    assert any((a != mean[name]).any() for name, a in replicas[0].weights().items())
    for before, replica in zip(others, replicas[1:]):
        for name, weights in replica.weights().items():
            np.testing.assert_array_equal(weights, before[name])


def test_federating_all_averages_moments_and_target_networks(city_mission):
    weights, some = (QNetworks(SETTINGS.model_copy(update={"federate_all": each}), city_mission, 0).weights()
                     for each in (True, False))
    assert {name.split(".")[0] for name in weights} == {"agent", "mixer", "target_agent", "target_mixer", "mean",
                                                        "square"}
    assert {name.split(".")[0] for name in some} == {"agent", "mixer"}


def test_processes_learn_the_same_as_this_one(city_mission, monkeypatch):
    monkeypatch.setattr(marl.replicas, "usable_cores", lambda: 2)
    here = [Trainer(*each) for each in arguments(city_mission)]
    replicas = Replicas(Trainer, arguments(city_mission))
    try:
        records = replicas.call("train", 8)
        assert records == [trainer.train(8) for trainer in here]
        there = replicas.call("weights")
        for trainer, weights in zip(here, there):
            for name, expected in trainer.weights().items():
                np.testing.assert_array_equal(weights[name], expected)
        replicas.call("set_weights", each=[there[1], there[0]])
        swapped = replicas.call("weights")
        np.testing.assert_array_equal(swapped[0]["agent.head.bias"], there[1]["agent.head.bias"])
        with pytest.raises(AttributeError, match="no_such_method"):
            replicas.call("no_such_method")
        [number] = replicas._pools[0]._processes
        os.kill(number, signal.SIGKILL)
        with pytest.raises(RunFailed, match="--resume"):
            replicas.call("train", 4)
    finally:
        replicas.close()
