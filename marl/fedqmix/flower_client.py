"""The ClientApp: a party that trains when the coordinator asks, and sends weights and counts.

What a party holds is named in `--node-config` of its own SuperNode. In Flower's simulation engine,
which has no such thing, it is in the file that the environment variable `RADIOTWIN_PARTIES` names.
"""

import os
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flwr.app import Context, Error, Message, MetricRecord, RecordDict
from flwr.clientapp import ClientApp

from marl.fedqmix.client import Client, Party
from marl.fedqmix.flower_records import arrays_of, weights_of
from marl.fedqmix.shared import Shared
from marl.threads import keep_memory, limit_threads
from radiotwin.errors import BadInput
from radiotwin.io.inputs import read_json
from radiotwin.runtime.cuda import torch_device
from radiotwin.runtime.processes import die_with_parent

PARTIES = "RADIOTWIN_PARTIES"
ERROR_CODE = 2  # of Flower: the ClientApp raised an exception
ERROR_REASON = "the party could not do it; its own log says why"
_NEEDED, _OPTIONAL = ("scene", "out", "number"), ("truth", "measurements", "device")

app = ClientApp()


@app.train()
def train(message: Message, context: Context) -> Message:
    """Train for a round from the mean, and reply with weights and the number of episodes."""
    def work(client: Client) -> RecordDict:
        number = message.content.config_records["config"]["server-round"]
        if type(number) is not int:
            raise BadInput("the round's number is missing")
        weights, episodes = client.train(number, weights_of(message))
        return RecordDict({"arrays": arrays_of(weights), "metrics": _count(episodes)})

    return _reply(message, context, work)


@app.evaluate()
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
