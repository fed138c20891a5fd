"""Coverage of a network on a street-level grid: received power, best server, SINR, rate, areas."""

from radiotwin.coverage.radio import CoverageSettings, RateModel
from radiotwin.coverage.run import Coverage, predict_coverage
from radiotwin.coverage.transmitters import Transmitter, read_transmitters, scene_transmitters

__all__ = ["Coverage", "CoverageSettings", "RateModel", "Transmitter", "predict_coverage",
           "read_transmitters", "scene_transmitters"]
