"""The rule that a scene reads only files in its own folder."""

from pathlib import Path

from radiotwin.errors import BadInput


def require_within(folder: Path, path: Path, source: str) -> Path:
    """Return the path if it lies in the folder once links are followed.

    Args:
        folder: Folder of the scene.
        path: File that the scene names.
        source: File, and line if known, that names it, for the message.

    Raises:
        BadInput: The path leaves the folder by `..`, by its root, or by a symbolic link.
    """
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # circular links, a name that no file can have
        inside = False
    if not inside:
        raise BadInput(f"{source}: {path} leads out of {folder}; a scene may name files in its own "
                       "folder only: copy the file there")
    return path
