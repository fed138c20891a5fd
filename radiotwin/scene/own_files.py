"""Files that a scene names: only those in its own folder are read, whatever the scene says."""

from pathlib import Path

from radiotwin.errors import BadInput


def require_within(folder: Path, path: Path, place: str) -> Path:
    """The path, if it is in the folder, links followed.

    Args:
        folder: of the scene.
        path: of a file that it names.
        place: where it is named, for the message.

    Raises:
        BadInput: it leads out of the folder, by `..`, by its root, or by a symbolic link.
    """
    try:
        inside = path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # links in a circle, a name that no file can have
        inside = False
    if not inside:
        raise BadInput(f"{place}: {path} leads out of {folder}; a scene may name files in its own folder only: copy "
                       "the file there")
    return path
