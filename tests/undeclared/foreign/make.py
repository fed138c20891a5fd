"""Trace all worlds that are not there yet.

    python -m tests.undeclared.foreign.make [--only city03 ...] [--split calibrate]

Needs libLLVM, and about a minute of one core a world. Each world is written as soon as it is traced:
run it again after an interruption and it continues. Worlds are taken in turn from both splits.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.undeclared.foreign.deck import DEALT, write_dealt
from tests.undeclared.foreign.layouts import SPLITS
from tests.undeclared.foreign.maps import write_truth
from tests.undeclared.foreign.paths import Tracer
from tests.undeclared.foreign.store import save, stored
from tests.undeclared.foreign.worlds import all_names, city_of, world


def make_world(name: str) -> None:
    """Trace a world and store its paths."""
    where = world(name)
    with TemporaryDirectory() as folder:
        tracer = Tracer(write_truth(Path(folder), where), where.frequency_hz, where.settings)
    save(where, [tracer.paths(device_m, where.campaign.points_m) for device_m in where.device_m])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[""], help="parts of names")
    parser.add_argument("--split", choices=SPLITS, help="one split only")
    given = parser.parse_args()
    if not DEALT.is_file():
        write_dealt()
    for name in all_names():
        wanted = any(part in name for part in given.only) and given.split in (None, city_of(name).split)
        if wanted and name not in stored():
            started, cpu_s = time.monotonic(), time.process_time()
            make_world(name)
            print(f"{name}: {time.monotonic() - started:.0f} s, {time.process_time() - cpu_s:.0f} s of a core",
                  flush=True)


if __name__ == "__main__":
    main()
