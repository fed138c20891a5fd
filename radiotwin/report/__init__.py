"""One HTML page of a run: the 3D city with radio maps, flights and devices in it, and the tables."""

from radiotwin.report.page import write_report
from radiotwin.report.run_folder import Run, read_run

__all__ = ["Run", "read_run", "write_report"]
