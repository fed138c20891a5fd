"""All that is wrong with an import, in one message."""

from collections.abc import Iterator
from contextlib import contextmanager

from radiotwin.errors import BadInput

_SHOWN = 20  # of the problems in a message


class Problems:
    """Collects messages of `BadInput`, so that reading goes on and finds the others."""

    def __init__(self) -> None:
        self._messages: list[str] = []

    def __len__(self) -> int:
        return len(self._messages)

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Keep the message of a `BadInput` raised within, and go on after it."""
        try:
            yield
        except BadInput as error:
            if str(error) not in self._messages:
                self._messages.append(str(error))

    def check(self) -> None:
        """Raise all messages as one.

        Raises:
            BadInput: there are some.
        """
        if not self._messages:
            return
        if len(self._messages) == 1:
            raise BadInput(self._messages[0])
        more = len(self._messages) - _SHOWN
        lines = self._messages[:_SHOWN] + [f"and {more} more"] * (more > 0)
        raise BadInput("\n".join([f"{len(self._messages)} things are wrong:",
                                  *(f"- {line}" for line in lines)]))
