"""Which task worked on what last: so Prefect's page draws which task follows which.

The tasks of a step start when all of the step before have ended. To draw that, each task would need
an edge from every other; what is drawn is whose results it works on.
"""

from collections import defaultdict
from collections.abc import Hashable, Iterable
from typing import Any, Protocol
from uuid import UUID

from prefect.client.schemas.objects import State, StateDetails
from prefect.states import Completed


class Submitted(Protocol):
    """Prefect's future, as far as it is needed here."""

    @property
    def task_run_id(self) -> UUID:
        """The id of the task's run."""


class Trail:
    """The tasks that worked last on a sensor, a span or both.

    Not the futures are kept, which hold results, but states that name the task's run.
    """

    def __init__(self) -> None:
        self._last: dict[Hashable, list[State[Any]]] = {}

    def after(self, *keys: Hashable) -> list[State[Any]]:
        """Return what a task that works on these has to wait for (`wait_for` of `submit`)."""
        found = {id(state): state for key in keys for state in self._last.get(key, [])}
        return list(found.values())

    def ran(self, futures: Iterable[Submitted], keys: Iterable[Iterable[Hashable]]) -> None:
        """Enter the tasks of a step, each with what it worked on."""
        last = defaultdict(list)
        for future, worked_on in zip(futures, keys, strict=True):
            details = StateDetails(task_run_id=future.task_run_id)
            state: State[Any] = Completed(data=True, state_details=details)
            for key in worked_on:
                last[key].append(state)
        self._last |= last
