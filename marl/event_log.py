"""Write TensorBoard events synchronously.

TensorBoard's own writer uses a thread, which ends in a traceback if the disk is full.
"""

import os
import shutil
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from radiotwin.errors import RunFailed

NAME = "events.out.tfevents.radiotwin"  # TensorBoard looks for the second part
VERSION = "brain.Event:2"


class EventLog:
    """TensorBoard events of one run.

    Args:
        folder: folder of the events; it is emptied, since a resumed run logs all rounds again.

    Raises:
        RunFailed: the disk is full or failed, here and in `flush`.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / NAME
        self._events = [Event(wall_time=time.time(), file_version=VERSION)]
        shutil.rmtree(folder, ignore_errors=True)
        try:
            folder.mkdir(parents=True)
        except OSError as error:
            raise self._failed(error) from error

    def add(self, group: str, step: int, values: Mapping[str, float]) -> None:
        """Add the finite values of one step under the tags `group/name`."""
        summary = Summary(value=[Summary.Value(tag=f"{group}/{name}", simple_value=value)
                                 for name, value in values.items() if np.isfinite(value)])
        self._events.append(Event(wall_time=time.time(), step=step, summary=summary))

    def flush(self) -> None:
        """Write the events added since the last call to disk."""
        try:
            with self._path.open("ab") as file:
                records = RecordWriter(file)
                for event in self._events:
                    records.write(event.SerializeToString())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise self._failed(error) from error
        self._events.clear()

    def _failed(self, error: OSError) -> RunFailed:
        """Return the error to raise if the events cannot be written."""
        return RunFailed(f"cannot write {self._path}: {error.strerror or error}; the finished "
                         "rounds are kept: make room, and go on with --resume")
