"""Followed paths, as arrays that can be kept."""

import numpy as np

Followed = dict[tuple[float, ...], dict[int, float]]
"""Position -> hash of the other end's position -> power."""


def followed_since(known: dict[tuple[float, ...], int], followed: Followed
                   ) -> dict[str, np.ndarray]:
    """Return positions (p, 3), numbers (p,) of ends, and hashes and powers of those, new ones."""
    new = {position_m: list(powers.items())[known.get(position_m, 0):]
           for position_m, powers in followed.items() if len(powers) > known.get(position_m, 0)}
    ends = [end for powers in new.values() for end in powers]
    return {"position_m": np.array(list(new)).reshape(-1, 3),
            "count": np.array([len(powers) for powers in new.values()], dtype=int),
            "hash": np.array([key for key, _ in ends], dtype=np.uint64),
            "power": np.array([power for _, power in ends], dtype=float)}


def add_followed(arrays: dict[str, np.ndarray], followed: Followed) -> None:
    """Add what `followed_since` returned."""
    ends = list(zip(arrays["hash"].tolist(), arrays["power"].tolist(), strict=True))
    if arrays["count"].sum() != len(ends):
        raise ValueError("other counts")
    last = np.cumsum(arrays["count"]).tolist()
    for position_m, end, count in zip(arrays["position_m"].tolist(), last,
                                      arrays["count"].tolist(), strict=True):
        if count:
            followed.setdefault(tuple(position_m), {}).update(ends[end - count:end])
