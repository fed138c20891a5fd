"""Ray tracing with Sionna RT: the simulated truth. Tracing needs libLLVM; importing does not."""

from radiotwin.trace.plan import choose_quality
from radiotwin.trace.run import read_points, trace_gains, trace_map, trace_points, truth_path
from radiotwin.trace.settings import QUALITIES, SolverSettings

__all__ = ["QUALITIES", "SolverSettings", "choose_quality", "read_points", "trace_gains",
           "trace_map", "trace_points", "truth_path"]
