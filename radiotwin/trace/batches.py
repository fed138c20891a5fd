"""Finished batches of a trace on disk, so that an interrupted one can be resumed."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.files import atomic_path
from radiotwin.interruption import note_finished


class BatchStore:
    """A folder of arrays that belong to one key.

    Args:
        root: Parent folder.
        key: Everything that decides the arrays; different keys have different folders.

    Attributes:
        hash: SHA-256 of the key.
        folder: The folder.
    """

    def __init__(self, root: Path, key: dict[str, Any]) -> None:
        text = json.dumps(key, sort_keys=True, indent=1)
        self.hash = hashlib.sha256(text.encode()).hexdigest()
        self.folder = root / f"trace-{self.hash[:12]}"
        if not (self.folder / "key.json").is_file():
            with atomic_path(self.folder / "key.json") as temporary:
                temporary.write_text(text + "\n", encoding="utf-8")

    def get(self, name: str, size: int) -> np.ndarray | None:
        """Read an array.

        Args:
            name: Name that it was saved under.
            size: Its length.

        Returns:
            (size,) array; None where it is absent or damaged.
        """
        try:
            array = np.load(self.folder / f"{name}.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None
        if array.shape != (size,):
            return None
        note_finished()
        return array

    def put(self, name: str, array: np.ndarray) -> None:
        """Save an array, completely or not at all.

        Args:
            name: Name in the store.
            array: One-dimensional array.
        """
        with atomic_path(self.folder / f"{name}.npy") as temporary:
            np.save(temporary, array, allow_pickle=False)
        note_finished()
