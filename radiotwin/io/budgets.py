"""Size limits of inputs, checked before memory is allocated.

A few bytes of a stranger's file can expand to gigabytes. The limits are far above ordinary use; an
environment variable raises one.
"""

import os
from dataclasses import dataclass
from typing import NoReturn

from radiotwin.errors import BadInput


@dataclass(frozen=True)
class Budget:
    """Limit of one quantity of an input.

    Attributes:
        name: of the environment variable that changes it, without `RADIOTWIN_MAX_`.
        default: limit if the variable is not set.
        unit: plural noun, for the message.
        of: the input that is limited, for the table in SECURITY.md.
    """

    name: str
    default: int
    unit: str
    of: str

    @property
    def variable(self) -> str:
        """Environment variable that changes the limit."""
        return f"RADIOTWIN_MAX_{self.name}"

    @property
    def limit(self) -> int:
        """Limit from the environment variable (BadInput: no positive integer), else the default."""
        text = os.environ.get(self.variable)
        if text is None:
            return self.default
        digits = text.strip().replace("_", "")
        if not (digits.isascii() and digits.isdigit() and len(digits) < 19 and int(digits)):
            raise BadInput(f"{self.variable}={text[:60]!r}: give a whole number of {self.unit} "
                           "above 0, or unset it")
        return int(digits)

    def check(self, amount: float, subject: object) -> None:
        """Raise BadInput if an amount is above the limit; the message begins with the subject."""
        if amount > self.limit:
            self.refuse(subject, f"{amount:,.0f} {self.unit}")

    def refuse(self, subject: object, amount: str) -> NoReturn:
        """Raise BadInput about a subject, such as a path, and an amount, such as `3 rows`."""
        raise BadInput(f"{subject}: {amount}; at most {self.limit:,} are read; if it is meant to "
                       f"be so large, set {self.variable} to a larger number")


# Files
FILE_BYTES = Budget("FILE_BYTES", 2 * 2**30, "bytes", "any file, after decompression")
DOCUMENT_BYTES = Budget("DOCUMENT_BYTES", 128 * 2**20, "bytes",
                        "a JSON document, which is tenfold in memory")
RECORD_BYTES = Budget("RECORD_BYTES", 32 * 2**20, "bytes",
                      "a JSON record of a run that a page shows")
ENTRIES = Budget("ENTRIES", 100_000, "entries", "one list or object in such a record")
SETTINGS_BYTES = Budget("SETTINGS_BYTES", 4 * 2**20, "bytes", "a TOML file")
NESTING = Budget("NESTING", 100, "levels of nesting", "JSON, TOML, XML and geometries")
# Tables
ROWS = Budget("ROWS", 50_000_000, "rows", "a table")
ROW_BYTES = Budget("ROW_BYTES", 16 * 2**20, "bytes in one row", "a CSV file")
COLUMNS = Budget("COLUMNS", 5_000, "columns", "a table")
TABLE_BYTES = Budget("TABLE_BYTES", 2**30, "bytes in memory", "a Parquet table, decoded")
CELLS = Budget("CELLS", 1_000_000_000, "cells", "a table: rows times columns")
BAG_CHUNK_BYTES = Budget("BAG_CHUNK_BYTES", 256 * 2**20, "bytes",
                         "one chunk of a ROS bag or MCAP file, after decompression")
IMPORT_FILES = Budget("IMPORT_FILES", 10_000, "files", "one import: in folders and zip files")
# Cities
DEVICES = Budget("DEVICES", 100_000, "devices", "a scene, or a table of devices")
UAVS = Budget("UAVS", 10_000, "UAVs", "a scene")
POSITIONS = Budget("POSITIONS", 100_000_000, "positions", "a lattice")
SHAPES = Budget("SHAPES", 200_000, "shapes", "a city")
VERTICES = Budget("VERTICES", 20_000_000, "vertices", "a city")
FACES = Budget("FACES", 40_000_000, "faces", "a city")
CORNERS = Budget("CORNERS", 10_000, "corners in one face", "a mesh; cutting it takes their square")
ELEMENTS = Budget("ELEMENTS", 2_000_000, "XML elements", "a city")
TAG_BYTES = Budget("TAG_BYTES", 8 * 2**20, "bytes in one tag", "an XML file")
FILES = Budget("FILES", 1_000, "files that include each other", "a Mitsuba file")
SEARCH_FOLDERS = Budget("SEARCH_FOLDERS", 100, "folders to search", "a Mitsuba file")
FEATURES = Budget("FEATURES", 5_000_000, "buildings", "a map file, before it is cut to a box")
OUTLINE_CORNERS = Budget("OUTLINE_CORNERS", 20_000, "corners", "one building of a map")
VEGETATION_CORNERS = Budget("VEGETATION_CORNERS", 50_000, "corners", "all vegetation of a scene")
VEGETATION_MEETINGS = Budget("VEGETATION_MEETINGS", 200_000, "meetings of its outlines",
                             "all vegetation of a scene")
TERRAIN_PIXELS = Budget("TERRAIN_PIXELS", 500_000_000, "pixels", "a terrain raster, of the scene")
TERRAIN_BLOCK_BYTES = Budget("TERRAIN_BLOCK_BYTES", 512 * 2**20, "bytes",
                             "one block of a terrain raster")
CROSSINGS = Budget("CROSSINGS", 2_000, "crossings of outlines with themselves", "a map")
OVERLAPS = Budget("OVERLAPS", 20_000, "pairs of buildings that overlap", "a map")
PART_PAIRS = Budget("PART_PAIRS", 2_000_000, "pairs of a building, part or roof and one around it",
                    "a map: so many lie on top of each other")
TOUCHING_CORNERS = Budget("TOUCHING_CORNERS", 5_000_000,
                          "corners in pairs of buildings that touch", "a map")
# Radio maps
MAP_VALUES = Budget("MAP_VALUES", 500_000_000, "values", "one variable of a radio map")
MAP_AXIS = Budget("MAP_AXIS", 20_000_000, "coordinates", "one axis of a radio map")
MAP_STREAM_VALUES = Budget("MAP_STREAM_VALUES", 100_000_000_000, "values",
                           "one variable of a radio map in Zarr that is read in parts")
MAP_CHUNKS = Budget("MAP_CHUNKS", 1_000_000, "pieces", "a variable as HDF5 or Zarr stores it")
MAP_PIECE_BYTES = Budget("MAP_PIECE_BYTES", 2**27, "bytes", "one piece of a radio map in Zarr")
MAP_ATTRIBUTES = Budget("MAP_ATTRIBUTES", 1_000, "attributes", "one variable")
COVERAGE_CELLS = Budget("COVERAGE_CELLS", 25_000_000, "cells",
                        "a coverage map: 40 bytes each in memory")
MAP_PICTURES = Budget("MAP_PICTURES", 2_000, "pictures", "a KMZ file")
# Paths
PATHS = Budget("PATHS", 5_000_000, "paths", "a list of paths: 630 bytes each in memory")
RESPONSE_VALUES = Budget("RESPONSE_VALUES", 50_000_000, "taps", "all impulse responses of a list")
# Pages
PAGE_VALUES = Budget("PAGE_VALUES", 1_000_000_000, "values", "all radio maps of a page")
PAGE_MAPS = Budget("PAGE_MAPS", 200, "radio maps", "a page")
PICTURE_BYTES = Budget("PICTURE_BYTES", 8 * 2**20, "bytes", "a figure in a page")
PICTURE_PIXELS = Budget("PICTURE_PIXELS", 50_000_000, "pixels", "a figure in a page")
# Twins and learners
FIELD_PAIRS = Budget("FIELD_PAIRS", 200_000_000, "pairs of points",
                     "a residual field: 8 bytes each")
TREE_NODES = Budget("TREE_NODES", 20_000_000, "nodes", "all regression trees of a twin")
TRAINING_BYTES = Budget("TRAINING_BYTES", 64 * 2**30, "bytes of memory", "a learner")
CHECKPOINT_BYTES = Budget("CHECKPOINT_BYTES", 64 * 2**30, "bytes", "a checkpoint")
# Cache
PIECE_BYTES = Budget("PIECE_BYTES", 256 * 2**20, "bytes", "one finished part")
CACHE_BYTES = Budget("CACHE_BYTES", 2 * 2**30, "bytes",
                     "all finished parts; the oldest are removed")
