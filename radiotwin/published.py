"""The published scenes, with their ray-traced radio maps: where they are on this machine."""

from pathlib import Path


def published_scene(name: str) -> Path:
    """Return the folder of a published scene.

    The scene in the folder `scenes` of the working directory comes first, then that of the source
    tree that the package was imported from, then the copy inside an installed package.

    Args:
        name: `rbm` or `rdm`.

    Returns:
        The first of these folders that exists; `scenes/NAME` where none does, so that the message
        of a missing scene names it.
    """
    package = Path(__file__).parent
    here = Path("scenes") / name
    candidates = (here, package.parent / here, package / here)
    return next((folder for folder in candidates if (folder / "scene.toml").is_file()), here)
