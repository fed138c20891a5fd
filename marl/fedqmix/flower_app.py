"""Flower App of a federation: parties train on request, a coordinator averages their weights.

The ClientApp sends weights and episode counts. Its party's files are named in `--node-config` of
the party's SuperNode; for Flower's simulation engine, the run's setting `parties` names a file with
all parties. The ServerApp checks the replies, averages them, and writes to the folder `out`.
"""

import os
import time
import traceback
from logging import INFO, WARNING
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from flwr.app import (
    Array,
    ArrayRecord,
    ConfigRecord,
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

from marl.checkpoint import save_checkpoint
from marl.fedqmix.client import Client, Party
from marl.fedqmix.federation import (
    Weights,
    initial_weights,
    require_weights,
    rounds_of,
    weighted_mean,
)
from marl.fedqmix.settings import Shared
from marl.replicas import keep_memory, limit_threads
from radiotwin.errors import BadInput, RunFailed
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path
from radiotwin.io.inputs import read_json
from radiotwin.runtime.cuda import torch_device
from radiotwin.runtime.processes import die_with_parent

ERROR_CODE = 2  # of Flower: the ClientApp raised an exception
ERROR_REASON = "the party could not do it; its own log says why"
_NEEDED, _OPTIONAL = ("scene", "out", "number"), ("truth", "measurements", "device")

client_app = ClientApp()  # Flower looks for a plain assignment in the source
server_app = ServerApp()


def arrays_of(weights: Weights) -> ArrayRecord:
    """Convert weights for sending, in double precision, since means are not rounded yet."""
    return ArrayRecord({name: Array(array.astype(np.float64)) for name, array in weights.items()})


def weights_of(message: Message) -> Weights:
    """Extract the weights of a message, in single precision."""
    [record] = message.content.array_records.values()
    return {name: np.asarray(array.numpy(), np.float32) for name, array in record.items()}


@client_app.train()
def train(message: Message, context: Context) -> Message:
    """Train for a round from the mean weights; reply with weights and the number of episodes."""
    return _reply(message, context)


@client_app.evaluate()
def evaluate(message: Message, context: Context) -> Message:
    """Evaluate the last mean weights for the party's log; reply with the number of flights."""
    return _reply(message, context)


def _reply(message: Message, context: Context) -> Message:
    """Train or evaluate, by the type of a message; on any error reply without details."""
    try:
        limit_threads(1)
        keep_memory()
        shared = Shared.of(context.run_config)
        client = Client(shared.run, shared.learner, party_of(context, shared))
        content = RecordDict()
        if message.metadata.message_type == MessageType.TRAIN:
            number = message.content.config_records["config"]["server-round"]
            if type(number) is not int:
                raise BadInput("the round's number is missing")
            weights, count = client.train(number, weights_of(message))
            content["arrays"] = arrays_of(weights)
        else:
            count = client.finish(weights_of(message))
        content["metrics"] = MetricRecord({"num-examples": count})
        return Message(content, reply_to=message)
    except Exception:
        # Flower would send the text of the exception, which may name files and values.
        traceback.print_exc()
        return Message(Error(ERROR_CODE, ERROR_REASON), reply_to=message)


def party_of(context: Context, shared: Shared) -> Party:
    """Return the party of this node from its configuration.

    Raises:
        BadInput: an entry is missing or unknown.
    """
    given: dict[str, Any] = dict(context.node_config)
    if "partition-id" in given:  # of the simulation engine
        given = read_json(shared.parties)[int(given["partition-id"])]
    else:
        # A party that outlives its killed SuperNode would overwrite the files of the next one.
        die_with_parent(os.getppid())
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


@server_app.main()
def main(grid: Grid, context: Context) -> None:
    """Average the parties' weights in every round, then ask each party to evaluate its policy."""
    shared = Shared.of(context.run_config)
    like = mean = initial_weights(shared)
    folder = Path(shared.out or f"federation-{context.run_id}")
    rows: list[dict] = []
    keep(0, mean, rows, folder)
    _wait(grid, shared.clients, shared.round_timeout_s)
    for number, (_, episodes) in enumerate(rounds_of(shared.run, shared.learner), 1):
        started = time.perf_counter()
        _wait(grid, shared.min_clients, shared.round_timeout_s)
        replies = usable(_ask(grid, shared, MessageType.TRAIN, mean, number), like, episodes)
        if len(replies) >= shared.min_clients:
            mean = weighted_mean(*zip(*replies))
        else:
            log(WARNING, "round %d: %d parties have answered, %d are needed; the mean stays",
                number, len(replies), shared.min_clients)
        rows.append({"round": number, "parties": len(replies),
                     "episodes": sum(count for _, count in replies),
                     "seconds": time.perf_counter() - started})
        keep(number, mean, rows, folder)
    if mean is like:
        raise RunFailed("in no round did enough parties train; their logs say why")
    last = _ask(grid, shared, MessageType.EVALUATE, mean, len(rows))
    log(INFO, "%d of %d parties have evaluated", sum(each.has_content() for each in last),
        shared.clients)


def usable(replies: list[Message], like: Weights, max_count: int) -> list[tuple[Weights, int]]:
    """Return weights and episode counts of the valid replies, and log the others.

    Replies may contain anything; weights should be `like` these, and counts at most `max_count`.
    """
    found = []
    for reply in replies:
        try:
            if reply.has_error():
                raise BadInput(reply.error.reason)
            weights, [metrics] = weights_of(reply), reply.content.metric_records.values()
            count = metrics["num-examples"]
            require_weights(weights, like)
            if type(count) is not int or not 1 <= count <= max_count:
                raise BadInput(f"it counts {count} episodes; allowed are 1 to {max_count}")
            found.append((weights, count))
        except (BadInput, KeyError, TypeError, ValueError) as error:
            log(WARNING, "a party's reply is left out: %.200s", error)
    return found


def keep(number: int, mean: Weights, rows: list[dict], folder: Path) -> None:
    """Write the mean weights of a round (0: the initial weights), and the table of rounds."""
    save_checkpoint({"round": number, "weights": {
        name: array.astype(np.float32) for name, array in mean.items()}},
        folder / "weights" / f"round-{number:05d}.safetensors")
    if rows:
        with atomic_path(folder / "rounds.csv") as temporary:
            write_csv(pd.DataFrame(rows), temporary)


def _ask(grid: Grid, shared: Shared, kind: str, mean: Weights, number: int) -> list[Message]:
    """Send mean weights to all connected parties, and return their replies."""
    content = RecordDict({"arrays": arrays_of(mean),
                          "config": ConfigRecord({"server-round": number})})
    messages = [Message(content, node, kind) for node in grid.get_node_ids()]
    return list(grid.send_and_receive(messages, timeout=shared.round_timeout_s))


def _wait(grid: Grid, count: int, timeout_s: float) -> None:
    """Wait until `count` parties are connected, at most for a timeout [s]."""
    end = time.monotonic() + timeout_s
    while len(list(grid.get_node_ids())) < count and time.monotonic() < end:
        time.sleep(0.5)
