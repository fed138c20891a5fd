"""Finished batches of a trace on disk, so that an interrupted one goes on where it was."""

import hashlib
import json
from pathlib import Path

import numpy as np

from radiotwin.files import atomic_path


class BatchStore:
    """A folder of arrays that belong to one key.

    Args:
        root: parent folder.
        key: everything that decides the arrays; whatever differs in anything goes to another folder.
    """

    def __init__(self, root: Path, key: dict):
        text = json.dumps(key, sort_keys=True, indent=1)
        self.hash = hashlib.sha256(text.encode()).hexdigest()
        self.folder = root / f"trace-{self.hash[:12]}"
        if not (self.folder / "key.json").is_file():
            with atomic_path(self.folder / "key.json") as temporary:
                temporary.write_text(text + "\n", encoding="utf-8")

    def get(self, name: str, size: int) -> np.ndarray | None:
        """The array (size,) of that name; None where it is absent or damaged."""
        try:
            array = np.load(self.folder / f"{name}.npy", allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None
        return array if array.shape == (size,) else None

    def put(self, name: str, array: np.ndarray) -> None:
        """Save an array, whole or not at all."""
        with atomic_path(self.folder / f"{name}.npy") as temporary:
            np.save(temporary, array, allow_pickle=False)
