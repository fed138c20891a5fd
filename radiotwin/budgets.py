"""Size limits of inputs, checked before memory is taken.

Files come from strangers: a few bytes can stand for gigabytes. The limits are far above what the
tool is made for; an environment variable raises one for those who know their file.
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
        default: limit where that variable is not set.
        unit: plural noun, for the message.
    """

    name: str
    default: int
    unit: str

    @property
    def variable(self) -> str:
        """Environment variable that changes the limit."""
        return f"RADIOTWIN_MAX_{self.name}"

    @property
    def limit(self) -> int:
        """Limit now.

        Raises:
            BadInput: the variable is set, and not to a positive whole number.
        """
        text = os.environ.get(self.variable)
        if text is None:
            return self.default
        digits = text.strip().replace("_", "")
        if not (digits.isascii() and digits.isdigit() and len(digits) < 19 and int(digits)):
            raise BadInput(f"{self.variable}={text[:60]!r}: give a whole number of {self.unit} "
                           "above 0, or unset it")
        return int(digits)

    def check(self, amount: float, subject: object) -> None:
        """Check an amount.

        Args:
            amount: as large as it is, or would get.
            subject: has it, such as the path of a file; the message begins with it.

        Raises:
            BadInput: the amount is above the limit.
        """
        if amount > self.limit:
            self.refuse(subject, f"{amount:,.0f} {self.unit}")

    def refuse(self, subject: object, amount: str) -> NoReturn:
        """Raise the message of an amount above the limit.

        Args:
            subject: the message begins with it.
            amount: with its unit, as far as it is known, such as `more than 3 rows`.

        Raises:
            BadInput: always.
        """
        raise BadInput(f"{subject}: {amount}; at most {self.limit:,} are read; if it is meant to "
                       f"be so large, set {self.variable} to a larger number")


FILE_BYTES = Budget("FILE_BYTES", 2 * 2**30, "bytes")  # after decompression
DOCUMENT_BYTES = Budget("DOCUMENT_BYTES", 128 * 2**20, "bytes")  # JSON: tenfold in memory
SETTINGS_BYTES = Budget("SETTINGS_BYTES", 4 * 2**20, "bytes")  # TOML
NESTING = Budget("NESTING", 100, "levels of nesting")
ROWS = Budget("ROWS", 50_000_000, "rows")
COLUMNS = Budget("COLUMNS", 5_000, "columns")
CELLS = Budget("CELLS", 1_000_000_000, "cells")  # rows times columns of a table
MAP_VALUES = Budget("MAP_VALUES", 500_000_000, "values")  # of one variable of a radio map
VERTICES = Budget("VERTICES", 20_000_000, "vertices")  # of a city, as is the next
FACES = Budget("FACES", 40_000_000, "faces")
SHAPES = Budget("SHAPES", 200_000, "shapes")
DEVICES = Budget("DEVICES", 100_000, "devices")
PIECE_BYTES = Budget("PIECE_BYTES", 256 * 2**20, "bytes")  # of one finished part in the cache
CACHE_BYTES = Budget("CACHE_BYTES", 2 * 2**30, "bytes")  # of all; the oldest are removed
