"""The Flower App: parties that train when they are asked, and a coordinator that makes the means.

The ClientApp sends weights and counts. What its party holds is named in `--node-config` of the
party's own SuperNode; in Flower's simulation engine, which has no such thing, it is in the file
that the environment variable `RADIOTWIN_PARTIES` names.

The ServerApp checks what parties sent, makes means of weights by Flower's strategies, and writes
into the folder that the environment variable `RADIOTWIN_FEDERATION` names.
"""

import json
import os
import time
import traceback
from collections.abc import Callable, Iterable
from logging import INFO, WARNING
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flwr.app import (
    Array,
    ArrayRecord,
    Context,
    Error,
    Message,
    MessageType,
    MetricRecord,
    RecordDict,
)
from flwr.clientapp import ClientApp
from flwr.common import log
from flwr.serverapp import Grid, ServerApp
from flwr.serverapp.strategy import FedAvg, FedAvgM, FedProx

from marl.checkpoint import save_checkpoint
from marl.fedqmix.client import Client, Party, rounds_of
from marl.fedqmix.federation import Weights, initial_weights, require_weights, weighted_mean
from marl.fedqmix.settings import Shared
from marl.replicas import keep_memory, limit_threads
from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_file, atomic_path
from radiotwin.io.inputs import read_json
from radiotwin.runtime.cuda import torch_device
from radiotwin.runtime.processes import die_with_parent

PARTIES = "RADIOTWIN_PARTIES"
ERROR_CODE = 2  # of Flower: the ClientApp raised an exception
ERROR_REASON = "the party could not do it; its own log says why"
_NEEDED, _OPTIONAL = ("scene", "out", "number"), ("truth", "measurements", "device")
FOLDER = "RADIOTWIN_FEDERATION"
WEIGHTS, ROUNDS, DONE = "weights", "rounds.csv", "done.json"

client_app = ClientApp()  # Flower looks for a plain assignment in the source
server_app = ServerApp()


def arrays_of(weights: Weights) -> ArrayRecord:
    """Return weights as Flower sends them.

    In double precision: Flower averages in the precision of what it gets, and the mean in single
    precision would be another one than `marl.fedqmix.federation.average`, after rounding.
    """
    return ArrayRecord({name: Array(array.astype(np.float64)) for name, array in weights.items()})


def weights_of(message: Message) -> Weights:
    """Return the weights in a message, in single precision."""
    [record] = message.content.array_records.values()
    return {name: np.asarray(array.numpy(), np.float32) for name, array in record.items()}


@client_app.train()
def train(message: Message, context: Context) -> Message:
    """Train for a round from the mean, and reply with weights and the number of episodes."""
    def work(client: Client) -> RecordDict:
        number = message.content.config_records["config"]["server-round"]
        if type(number) is not int:
            raise BadInput("the round's number is missing")
        weights, episodes = client.train(number, weights_of(message))
        return RecordDict({"arrays": arrays_of(weights), "metrics": _count(episodes)})

    return _reply(message, context, work)


@client_app.evaluate()
def evaluate(message: Message, context: Context) -> Message:
    """Evaluate the last mean for the party's own log, and reply with the number of flights."""
    def work(client: Client) -> RecordDict:
        return RecordDict({"metrics": _count(client.finish(weights_of(message)))})

    return _reply(message, context, work)


def party_of(context: Context) -> Party:
    """Return what this node's party holds.

    Raises:
        BadInput: something is missing or unknown in its configuration.
    """
    given: dict[str, Any] = dict(context.node_config)
    if PARTIES in os.environ:
        given = read_json(os.environ[PARTIES])[int(given["partition-id"])]
    missing = [name for name in _NEEDED if name not in given]
    odd = [name for name in given if name not in _NEEDED + _OPTIONAL]
    if missing or odd:
        raise BadInput(f"node-config: {(missing or odd)[0]} is {'missing' if missing else 'odd'}; "
                       f"needed are {', '.join(_NEEDED)}; allowed are {', '.join(_OPTIONAL)}")
    if type(given["number"]) is not int or not 0 <= given["number"] < 10_000:
        raise BadInput(f"node-config: number={given['number']}; allowed are 0 to 9999, another one "
                       "for every party")
    measurements = given.get("measurements")
    # A folder for every Flower run: the next one begins anew.
    folder = Path(str(given["out"])) / f"run-{context.run_id}"
    return Party(Path(str(given["scene"])), folder, given["number"],
                 str(given.get("truth", "traced")), Path(measurements) if measurements else None,
                 torch_device(str(given.get("device", "cpu"))))


def _reply(message: Message, context: Context, work: Callable[[Client], RecordDict]) -> Message:
    try:
        if PARTIES not in os.environ:
            # One that outlives its killed SuperNode would write over what the next one does.
            die_with_parent(os.getppid())
        limit_threads(1)
        keep_memory()
        shared = Shared.of(context.run_config)
        client = Client(shared.run, shared.learner, party_of(context), shared.proximal_mu)
        return Message(work(client), reply_to=message)
    except Exception:
        # Flower would send the text of the exception, which may name files and values.
        traceback.print_exc()
        return Message(Error(ERROR_CODE, ERROR_REASON), reply_to=message)


def _count(number: int) -> MetricRecord:
    return MetricRecord({"num-examples": number})


@server_app.main()
def main(grid: Grid, context: Context) -> None:
    """Run all rounds, then have each party evaluate its policy for itself."""
    die_with_parent(os.getppid())  # Flower's own end waits for a SuperLink that is no more
    shared = Shared.of(context.run_config)
    initial = initial_weights(shared)
    rounds = rounds_of(shared.run, shared.learner)
    record = Record(Path(os.environ.get(FOLDER, f"federation-{context.run_id}")))
    strategy = make_strategy(shared, initial, [episodes for _, episodes in rounds], record)
    timeout_s = shared.federation.round_timeout_s
    _wait(grid, shared, timeout_s)
    result = strategy.start(grid, arrays_of(initial), num_rounds=len(rounds), timeout=timeout_s,
                            evaluate_fn=record.keep)
    if not result.arrays:
        raise RunFailed("in no round did enough parties train; their logs say why")
    messages = [Message(RecordDict({"arrays": result.arrays}), node, MessageType.EVALUATE)
                for node in grid.get_node_ids()]
    replies = list(grid.send_and_receive(messages, timeout=timeout_s))
    evaluated = sum(reply.has_content() for reply in replies)
    log(INFO, "%d of %d parties have evaluated", evaluated, shared.clients)
    record.close(evaluated)


class Record:
    """Folder with the mean after every round, and a table of the rounds."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._rows = folder, list[dict]()
        self._started = time.perf_counter()
        self.heard, self.episodes = 0, 0  # in the present round

    def keep(self, number: int, arrays: ArrayRecord) -> MetricRecord | None:
        """Write the mean of a round, or the initial weights."""
        weights = {name: np.asarray(array.numpy(), np.float32) for name, array in arrays.items()}
        save_checkpoint({"round": number, "weights": weights},
                        self._folder / WEIGHTS / f"round-{number:05d}.safetensors")
        if number:
            now = time.perf_counter()
            self._rows.append({"round": number, "parties": self.heard, "episodes": self.episodes,
                               "seconds": now - self._started})
            with atomic_path(self._folder / ROUNDS) as temporary:
                write_csv(pd.DataFrame(self._rows), temporary)
        self.heard, self.episodes, self._started = 0, 0, time.perf_counter()
        return None

    def close(self, evaluated: int) -> None:
        """Write that all is done."""
        with atomic_file(self._folder / DONE) as file:
            file.write(json.dumps({"rounds": len(self._rows), "evaluated": evaluated}).encode())


class _Checked(FedAvg):
    """A strategy that leaves out replies that are no weights, and rounds with too few of them."""

    like: Weights
    most: list[int]  # episodes of each round
    record: Record

    def aggregate_train(self, server_round: int, replies: Iterable[Message],
                        ) -> tuple[ArrayRecord | None, MetricRecord | None]:
        """Return the mean; None where the round does not count."""
        usable = [reply for reply in replies if self._usable(reply, self.most[server_round - 1])]
        self.record.heard = len(usable)
        self.record.episodes = sum(_episodes(reply) for reply in usable)
        if len(usable) < self.min_train_nodes:
            log(WARNING, "round %d: %d parties have answered, %d are needed; the mean stays",
                server_round, len(usable), self.min_train_nodes)
            return None, None
        # Flower multiplies before it adds. Where weights of both signs cancel, the rounding of that
        # shows in single precision, depends on the order of the replies, and grows over rounds.
        counts = [_episodes(reply) for reply in usable]
        mean = weighted_mean([weights_of(reply) for reply in usable], counts)
        merged = Message(RecordDict({"arrays": arrays_of(mean),
                                     "metrics": MetricRecord({"num-examples": sum(counts)})}),
                         reply_to=usable[0])
        return super().aggregate_train(server_round, [merged])

    def _usable(self, reply: Message, most: int) -> bool:
        if reply.has_error():
            log(WARNING, "a party did not train: %.200s", reply.error.reason)
            return False
        try:
            require_weights(weights_of(reply), self.like)
            if not 1 <= _episodes(reply) <= most:
                raise BadInput(f"it counts {_episodes(reply)} episodes; allowed are 1 to {most}")
        except (BadInput, KeyError, TypeError, ValueError) as error:
            log(WARNING, "a party's reply is left out: %.200s", error)
            return False
        return True


class _FedAvgM(_Checked, FedAvgM):
    pass


class _FedProx(_Checked, FedProx):
    pass


def make_strategy(shared: Shared, like: Weights, most: list[int], record: Record) -> FedAvg:
    """Return Flower's strategy, with its replies checked.

    Weights are to be like the given ones, and episodes at most those of each round.
    """
    federation = shared.federation
    made: dict[str, tuple[type[_Checked], dict[str, Any]]] = {
        "fedavg": (_Checked, {}),
        "fedavgm": (_FedAvgM, {"server_momentum": federation.server_momentum}),
        "fedprox": (_FedProx, {"proximal_mu": federation.proximal_mu})}
    strategy_class, options = made[federation.strategy]
    strategy = strategy_class(fraction_evaluate=0.0, min_train_nodes=federation.min_clients,
                              min_available_nodes=federation.min_clients, **options)
    strategy.like, strategy.most, strategy.record = like, most, record
    return strategy


def _episodes(reply: Message) -> int:
    [metrics] = reply.content.metric_records.values()
    count = metrics["num-examples"]
    if type(count) is not int:
        raise BadInput("its count of episodes is no whole number")
    return count


def _wait(grid: Grid, shared: Shared, timeout_s: float) -> None:
    """Wait for all parties; after a while go on with those that are there."""
    end = time.monotonic() + timeout_s
    while len(list(grid.get_node_ids())) < shared.clients and time.monotonic() < end:
        time.sleep(0.5)
