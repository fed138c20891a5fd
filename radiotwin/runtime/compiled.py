"""Import numba's `njit` with two of its faults mended.

numba imports the package `coverage`, and fails if a folder of that name is on the path. The output
of `radiotwin coverage` may be such a folder, in the working directory.

numba compiles a cached function again if its own file has changed, but not if a function that it
calls has changed in another file. Here the cache of a file also depends on the other files with
compiled functions in its folder.
"""

import os
import sys
from functools import lru_cache
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

__all__ = ["List", "njit"]


def _path_without_folder(name: str) -> list[str]:
    """Return `sys.path` without entries in which a name is a mere folder, no package with code."""
    found = find_spec(name) if name not in sys.modules else None
    folders: list[str] = []
    if found is not None and found.origin is None:
        folders += found.submodule_search_locations or ()
    return [each for each in sys.path if os.path.join(os.path.abspath(each), name) not in folders]


_whole_path = sys.path[:]
sys.path[:] = _path_without_folder("coverage")
try:
    from numba import njit
    from numba.core.caching import _SourceFileBackedLocatorMixin as _Locator
    from numba.typed import List
finally:
    sys.path[:] = _whole_path

_stamp_of_file = _Locator.get_source_stamp


@lru_cache
def _compiled_files_hash(folder: Path) -> str | None:
    """Return the hash of the files with compiled functions in a folder; None if there are none."""
    contents = [path.read_bytes() for path in sorted(folder.glob("*.py"))]
    compiled = [content for content in contents if __name__.encode() in content]
    return sha256(b"".join(compiled)).hexdigest() if compiled else None


def _stamp(self: Any) -> Any:
    """Return the stamp of the sources, which must be equal for cached code to be used."""
    others = _compiled_files_hash(Path(self._py_file).parent)
    return _stamp_of_file(self) if others is None else (_stamp_of_file(self), others)


_Locator.get_source_stamp = _stamp  # type: ignore[method-assign]
