"""How objects show themselves: a line, a table in a notebook, axes of a plot, rows for a GIS."""

from radiotwin.display.axes import PlotFrame, new_axes
from radiotwin.display.summary import Summary, geo_data_frame

__all__ = ["PlotFrame", "Summary", "geo_data_frame", "new_axes"]
