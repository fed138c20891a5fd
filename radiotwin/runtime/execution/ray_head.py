"""A Ray cluster of one command on this machine, in a process group of its own.

Run as a script. It prints the cluster's address, and ends the cluster and itself when its standard
input closes: that of a driver that was killed closes, too. Ray's own helpers may outlive a killed
driver by a minute.
"""

import json
import os
import shutil
import signal
import sys
from typing import Any


def main() -> None:
    """Start the cluster, print its address, and wait for the end of standard input."""
    options = json.loads(sys.stdin.readline())
    import ray

    try:
        head: Any = ray.init(include_dashboard=False, log_to_driver=False,
                             configure_logging=False, **options)
        print(json.dumps({"address": head.address_info["address"]}), flush=True)
        sys.stdin.read()
        ray.shutdown()
    finally:
        shutil.rmtree(options["_temp_dir"], ignore_errors=True)
        os.killpg(os.getpgrp(), signal.SIGKILL)


if __name__ == "__main__":
    main()
