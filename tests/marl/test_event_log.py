"""TensorBoard reads what was logged; a disk that takes nothing is an error at once."""

import math

import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from marl.event_log import EventLog
from radiotwin.errors import RunFailed


def events(folder):
    (path,) = folder.iterdir()
    return [(event.step, value.tag, value.tensor.float_val[0] if value.HasField("tensor") else value.simple_value)
            for event in EventFileLoader(str(path)).Load() for value in event.summary.value]


def test_tensorboard_reads_all_that_was_flushed(tmp_path):
    log = EventLog(tmp_path / "run" / "tensorboard")
    log.add("round", 1, {"truth_ratio": 0.5, "twin_ratio": math.nan, "located": 3})
    log.flush()
    log.add("train", 40, {"loss": 2.0})
    log.flush()
    assert events(tmp_path / "run" / "tensorboard") == [(1, "round/truth_ratio", 0.5), (1, "round/located", 3.0),
                                                        (40, "train/loss", 2.0)]


def test_a_resumed_run_has_nothing_twice(tmp_path):
    for _ in range(2):
        log = EventLog(tmp_path / "tensorboard")
        log.add("round", 1, {"truth_ratio": 0.5})
        log.flush()
    assert len(events(tmp_path / "tensorboard")) == 1


def test_a_disk_that_takes_nothing_is_one_error(tmp_path):
    """At 0f68f2a it was a traceback of a thread besides."""
    log = EventLog(tmp_path / "tensorboard")
    (tmp_path / "tensorboard" / "events.out.tfevents.radiotwin").symlink_to("/dev/full")
    log.add("round", 1, {"truth_ratio": 0.5})
    with pytest.raises(RunFailed, match="tensorboard.*No space left.*--resume"):
        log.flush()
