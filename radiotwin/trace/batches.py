"""Finished batches of a trace on disk, so that an interrupted one can be resumed."""

import hashlib
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from radiotwin.errors import BadInput
from radiotwin.io.files import atomic_path
from radiotwin.io.inputs import read_bytes, require_within
from radiotwin.io.signals import note_finished


class BatchStore:
    """A folder of arrays that belong to one key.

    Args:
        scene_folder: Its folder `cache` holds them.
        key: Everything that decides the arrays; different keys have different folders.

    Attributes:
        hash: SHA-256 of the key.
        folder: The folder.
    """

    def __init__(self, scene_folder: Path, key: dict[str, Any]) -> None:
        text = json.dumps(key, sort_keys=True, indent=1)
        self.hash = hashlib.sha256(text.encode()).hexdigest()
        self.folder = require_within(scene_folder,
                                     scene_folder / "cache" / f"trace-{self.hash[:12]}",
                                     str(scene_folder))
        if not (self.folder / "key.json").is_file():
            with atomic_path(self.folder / "key.json") as temporary:
                temporary.write_text(text + "\n", encoding="utf-8")

    def get(self, name: str, size: int) -> np.ndarray | None:
        """Read an array.

        Args:
            name: Name that it was saved under.
            size: Its length.

        Returns:
            (size,) array; None where it is absent, damaged, or not as `put` writes it.
        """
        try:
            data = read_bytes(self.folder / f"{name}.npy", "batch of a trace")
        except BadInput:
            return None
        if len(data) < 8 * size:
            return None
        array = np.frombuffer(data[len(data) - 8 * size:], dtype=float)
        if data != _file_content(array):
            return None
        note_finished()
        return array

    def put(self, name: str, array: np.ndarray) -> None:
        """Save an array, completely or not at all.

        Args:
            name: Name in the store.
            array: (n,) floats.
        """
        with atomic_path(self.folder / f"{name}.npy") as temporary:
            temporary.write_bytes(_file_content(array))
        note_finished()


def _file_content(array: np.ndarray) -> bytes:
    """Return the bytes of a `.npy` file of floats."""
    file = io.BytesIO()
    np.save(file, np.asarray(array, dtype=float), allow_pickle=False)
    return file.getvalue()
