"""A case: a target, and changes of its file. Cases are small JSON records, so that a failed one is kept."""

import json
import os
import random
import socket
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.fuzz.mutations import Mutation, apply, names
from tests.fuzz.sandbox import Outcome, prepare_case, run_watched
from tests.fuzz.targets import TARGETS, Target, suffix_of

CORPUS = Path(__file__).with_name("corpus.jsonl")
# Instead of the file: links, pipes and folders where a file should be.
KINDS = ("pipe", "folder", "link out", "link to a device", "loop", "absent", "huge")
MUTATION_COUNT = (1, 1, 1, 2, 3, 6)


@dataclass(frozen=True)
class Case:
    """A target by its file and command, and what is done to the file."""

    file: str
    command: str
    mutations: tuple[Mutation, ...] = ()
    instead: str = ""

    def dumps(self) -> str:
        """Return the case as one line of JSON."""
        return json.dumps(asdict(self))

    @property
    def kind(self) -> str:
        """Class of its file, in the counts."""
        return next((target.kind for target in TARGETS if (target.file, target.command) == (self.file, self.command)),
                    "gone")


def loads(line: str) -> Case:
    """Return a case from one line of JSON."""
    record = json.loads(line)
    mutations = tuple(Mutation(**each) for each in record.pop("mutations"))
    return Case(**record, mutations=mutations)


def instead_of(target: Target) -> list[str]:
    """Return what may be put instead of a file; a file that the user names may be a link to any place."""
    named = target.file in target.command.split()
    return [kind for kind in KINDS if not (named and kind == "link out")]


def draw(rng: random.Random, targets: list[Target]) -> Case:
    """Draw a case."""
    target = rng.choice(targets)
    if rng.random() < 0.03 and target.suffix != ".args":
        return Case(target.file, target.command, (), rng.choice(instead_of(target)))
    kinds = names(target.suffix)
    return Case(target.file, target.command, tuple(
        Mutation(rng.choice(kinds), round(rng.random(), 6), rng.randrange(10**6)) for _ in range(rng.choice(MUTATION_COUNT))))


def listen() -> socket.socket:
    """Return a server on this machine that nothing may call."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen(8)
    listener.setblocking(False)
    return listener


def run_case(case: Case, honest: Path, folder: Path, listener: socket.socket) -> Outcome:
    """Damage a copy of the honest files, run the command and judge what it did."""
    work = prepare_case(honest, folder)
    path = work / case.file
    if case.instead:
        _put_instead(path, case.instead, folder)
    else:
        data = path.read_bytes()
        for mutation in case.mutations:
            data = apply(mutation, data, suffix_of(path.name), listener.getsockname()[1])
        path.write_bytes(data)
    return run_watched(case.command, folder, listener)


def _put_instead(path: Path, kind: str, folder: Path) -> None:
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "link out":
        path.symlink_to(folder / "canary")
    elif kind == "link to a device":
        path.symlink_to("/dev/zero")
    elif kind == "loop":
        path.symlink_to(path)
    elif kind == "huge":
        with open(path, "wb") as file:
            file.truncate(2**40)
