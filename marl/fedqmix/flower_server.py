"""The ServerApp: means of weights by Flower's strategies, after a check of what parties sent.

It writes into the folder that the environment variable `RADIOTWIN_FEDERATION` names.
"""

import json
import os
import time
from collections.abc import Iterable
from logging import INFO, WARNING
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flwr.app import ArrayRecord, Context, Message, MessageType, MetricRecord, RecordDict
from flwr.common import log
from flwr.serverapp import Grid, ServerApp
from flwr.serverapp.strategy import FedAvg, FedAvgM, FedProx

from marl.checkpoint import save_checkpoint
from marl.fedqmix.client import rounds_of
from marl.fedqmix.federation import Weights, require_weights, weighted_mean
from marl.fedqmix.flower_records import arrays_of, weights_of
from marl.fedqmix.shared import Shared, initial_weights
from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_file, atomic_path
from radiotwin.runtime.processes import die_with_parent

FOLDER = "RADIOTWIN_FEDERATION"
WEIGHTS, ROUNDS, DONE = "weights", "rounds.csv", "done.json"

app = ServerApp()


@app.main()
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

    Args:
        shared: settings.
        like: weights of the right names and shapes.
        most: training episodes of each round.
        record: is told how many parties a round heard.
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
