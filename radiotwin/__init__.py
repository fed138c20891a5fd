"""Radio digital twins of cities, learnt from measurements."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("radiotwin")
except PackageNotFoundError:  # run from a source tree that was never installed
    __version__ = "0+source"
