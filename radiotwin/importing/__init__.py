"""Import measurements from logs and tables of any layout, with a report."""

from radiotwin.importing.run import import_files, import_measurements
from radiotwin.importing.settings import Settings, parse_columns, read_settings

__all__ = ["Settings", "import_files", "import_measurements", "parse_columns", "read_settings"]
