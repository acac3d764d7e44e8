"""The nights of a dataset: what each holds, and whether a run would make it otherwise today."""

from dataclasses import dataclass
from typing import Any

from epipole.flows.night.dataset.earlier_nights import EarlierNights
from epipole.flows.night.dataset.night_rows import recipe_in
from epipole.io.datasets.dataset import missing_tables, night_row, nights_in
from epipole.io.work.recipe import recipe_of
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings

# What differs, by the field of a `Recipe`. Logs are not held against anything.
_DIFFERS = {
    "settings": "other settings",
    "star_catalogue": "another star catalogue",
    "code": "other code",
    "known": "another catalogue of known objects",
}


@dataclass(frozen=True)
class HeldNight:
    """A night of a dataset: its row of `nights`, empty without one, and why it is stale."""

    date: str
    row: dict[str, Any]
    stale: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the night as JSON takes it."""
        return {"night": self.date, "stale": self.stale, **self.row}


def held_nights(dataset: str, settings: Settings, known: str | None) -> list[HeldNight]:
    """Return the nights of a dataset in order.

    Parameters
    ----------
    settings
        Those that a run would have today.
    known
        Digest of the catalogue of known objects that a run would have. None: whatever each night
        was made with.
    """
    return [_held(dataset, date, settings, known) for date in nights_in(dataset)]


def _held(dataset: str, date: str, settings: Settings, known: str | None) -> HeldNight:
    try:
        missing = missing_tables(dataset, date)
        row = night_row(dataset, date)
    except DatasetError as error:
        return HeldNight(date, {}, [str(error)])
    if row is None:
        return HeldNight(date, {}, ["an older version"])
    made_from = recipe_in(row)
    today = recipe_of(row["logs_key"], settings, known or row["known_key"])
    stale = [
        text for name, text in _DIFFERS.items() if getattr(made_from, name) != getattr(today, name)
    ]
    if row["earlier_key"] != EarlierNights(dataset, {}).key(date, settings):
        stale.append("another night before")
    return HeldNight(date, row, stale + [f"no table {name}" for name in missing])
