"""numba's compiler, imported so that a folder named `coverage` does it no harm.

numba imports the package `coverage` where there is one, takes a folder of that name on the path for
it, and fails. The output of `radiotwin coverage` may be such a folder, in the working directory.
"""

import os
import sys
from importlib.util import find_spec

__all__ = ["njit"]


def _path_without_folder(name: str) -> list[str]:
    """Return the entries of `sys.path` in which a name is not that of a folder without code."""
    found = find_spec(name) if name not in sys.modules else None
    folders: list[str] = []
    if found is not None and found.origin is None:
        folders += found.submodule_search_locations or ()
    return [each for each in sys.path if os.path.join(os.path.abspath(each), name) not in folders]


_whole_path = sys.path[:]
sys.path[:] = _path_without_folder("coverage")
try:
    from numba import njit
finally:
    sys.path[:] = _whole_path
