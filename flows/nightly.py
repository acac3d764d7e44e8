"""The nightly flow: logs of star sensors go in, a dataset of space objects comes out."""

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
from prefect import flow

from epipole.flows.night.calibrating import calibrate, find_cameras
from epipole.flows.night.doubt import settle
from epipole.flows.night.log_checks import (
    check_logs,
    check_readings,
    check_star_scatter,
    wrong_velocities,
)
from epipole.flows.night.log_choice import (
    LastNights,
    Night,
    find_logs,
    night_asked,
    nights_asked_before,
    run_name,
)
from epipole.flows.night.recorded_nights import (
    EarlierNights,
    gave_something,
    night_logs_key,
    unchanged_nights,
    write_night_row,
)
from epipole.flows.night.reports import with_reports
from epipole.flows.night.run_records import Stopwatch, record_unchanged, write_record
from epipole.flows.night.stages import (
    Destination,
    check,
    choose_elements,
    determine_orbits,
    identify,
    list_objects,
    name,
    name_known,
    publish,
    read,
    solve,
    track,
    write_night,
)
from epipole.flows.night.summary import Summary, many, summarise
from epipole.flows.night.work import Work, cameras_of_night, plan_spans
from epipole.flows.prefect.artifacts import shown_on_page, tell
from epipole.flows.prefect.runners import runner_asked
from epipole.flows.prefect.waiting_runs import waiting_nights
from epipole.io.catalogues.element_sets import KnownObjects, read_known_objects
from epipole.io.catalogues.star_catalogue import check_star_catalogue
from epipole.io.datasets.dataset import (
    check_folder,
    check_sources,
    lock_nights,
    night_location,
)
from epipole.io.datasets.rows_by_night import nights_of
from epipole.io.paths import known_as, line_of
from epipole.io.settings_file import merged_settings
from epipole.io.work.folder import work_folder, work_root
from epipole.io.work.recipe import Recipe, recipe_of
from epipole.io.work.work_layout import ReadFolder, SolvedParts, WorkFolder
from epipole.schemas.bridge import concat
from epipole.schemas.dates import LAST_NIGHTS, YESTERDAY
from epipole.schemas.errors import EpipoleError, LogError, NoFramesError
from epipole.schemas.rejects import Reason, by_reason
from epipole.schemas.run_record import RunState
from epipole.schemas.settings import Settings
from epipole.schemas.spans import day_of
from epipole.schemas.tables import REJECTS
from epipole.tasks.publish.write_tables import into_nights, source_table
from epipole.tasks.read.order_frames import OrderedFrames

LOGGER = logging.getLogger(__name__)


@flow(
    name="nightly", flow_run_name=run_name, task_runner=runner_asked(),
    persist_result=False,  # else a server can name a storage for it
)  # fmt: skip
@shown_on_page
def nightly(
    logs: str | list[str],
    out: str,
    settings: Settings = Settings(),  # noqa: B008  frozen
    night: Night = None,
    replace: bool = False,
    known: str | None = None,
    again: bool = False,
    settings_file: str | None = None,
    last_nights: LastNights = LAST_NIGHTS,
) -> Summary:
    """Turn logs into a dataset.

    Prefect's form for a run shows the text under Args.

    Args:
        logs: MCAP files, folders, globs or URLs of them; the logs of the night are chosen.
        out: The dataset, a folder or URL; it is created if missing.
        settings: Groups of settings, as in a settings file; missing ones keep their defaults.
        night: Publish only this UTC date: YYYY-MM-DD, or yesterday (the day before the run was
            scheduled); or the dates of a range, in order: 2019-04-01/2019-04-30. None: every night
            that the logs have frames of.
        replace: Replace a night even if one of its earlier logs is not given.
        known: A file of element sets, to name known objects by: two-line elements, or OMM in CSV,
            JSON or XML. A path or URL. None: no object gets a name.
        again: Make a night again even if nothing has changed since it was made.
        settings_file: A file of settings (TOML): a path or URL that the worker can read. Settings
            that are given count more.
        last_nights: With night yesterday, the number of nights that are made, in order, where a
            log has come since or anything else has changed; yesterday is the last of them.

    Raises:
        EpipoleError: If the work cannot be done; the dataset is then unchanged.
    """
    logs = [known_as(where) for where in ([logs] if isinstance(logs, str) else logs)]
    out, known = known_as(out), None if known is None else known_as(known)
    asked = night_asked(night)
    settings = merged_settings(settings_file, settings)
    check_folder(out)
    check_star_catalogue(settings.identification.catalogue)
    catalogue = read_known_objects(known) if known else None
    order = Order(logs, out, settings, catalogue, replace, again, {})
    before = nights_asked_before(night, asked, last_nights)
    waiting = (date for date in waiting_nights() if asked and date < asked)
    remade = set(before) if again and night != YESTERDAY else set()
    earlier = tuple(
        sentence
        for date in sorted({*before, *waiting})
        if (sentence := make_earlier_night(order._replace(again=date in remade), date))
    )
    try:
        summary = make_and_record(order, asked)
    except NoFramesError as error:
        raise NoFramesError("; ".join([str(error), *earlier])) from error
    return dataclasses.replace(summary, earlier=earlier)


class Order(NamedTuple):
    """What a run is to do, without the nights; `logged` is the argument of `find_logs`."""

    logs: list[str]
    out: str
    settings: Settings
    catalogue: KnownObjects | None
    replace: bool
    again: bool
    logged: dict[str, tuple[int, int] | None]


def make_earlier_night(order: Order, night: str) -> str | None:
    """Make a night before the one that is asked for; return a sentence, None if nothing was to do.

    If it fails, the night that is asked for is made all the same.
    """
    try:
        summary = make_and_record(order, night, asked=False)
    except NoFramesError:
        return None
    except EpipoleError as error:
        LOGGER.warning("night %s: %s", night, error)
        return f"{night} failed: {error}"
    except Exception as error:  # whatever it is
        LOGGER.exception("night %s", night)
        return f"{night} failed: {line_of(error)}"
    return None if summary.unchanged else f"{night} made: {summary.sentence()}"


def make_and_record(order: Order, night: str | None, asked: bool = True) -> Summary:
    """Make nights as `make_nights` does, record how that ended, and tell once what needs a look.

    `asked`: the run is for this night. Then Prefect shows a failure; only a night without frames
    is reported here.
    """
    used = Stopwatch.start()
    try:
        summary = make_nights(order, night)
    except Exception as error:
        is_empty = isinstance(error, NoFramesError)
        if night is not None and (asked or not is_empty):
            state = RunState.NO_FRAMES if is_empty else RunState.FAILED
            line = line_of(error)
            is_new = write_record(order.out, night, state, line, used, order.settings)
            if is_new and (is_empty or not asked):
                tell(order.out, night, f"{state.value}: {line}")
        raise
    if summary.unchanged:
        return record_unchanged(summary, used, order.settings)
    for date in summary.nights:
        looks = summary.looks.get(date, [])
        is_new = write_record(order.out, date, RunState.MADE, summary.sentence(), used,
                              order.settings, looks)  # fmt: skip
        if looks and is_new:
            tell(order.out, date, f"needs a look: {'; '.join(looks)}")
    return summary


def make_nights(order: Order, night: str | None) -> Summary:
    """Make a night, or all nights that the logs have frames of (None), where one has changed."""
    logs, out, settings, catalogue, replace, again, logged = order
    given = find_logs(logs, night, logged)
    LOGGER.info("found %s%s", many(len(given.paths), "log"), f" of {night}" if night else "")
    known_key = catalogue.sha256 if catalogue else None
    if not again and (same := unchanged_nights(out, given, night, settings, known_key)):
        LOGGER.info("unchanged: %s", ", ".join(same))
        return summarise(out, {date: night_location(out, date) for date in same}, unchanged=True)
    # Locks are released by `with`: a signal while an ExitStack takes one would leave it locked.
    with lock_nights(out, [night] if night else []) as run:
        frames = read(given.paths, ReadFolder(run), settings)
        nights = nights_of(frames.starts_ns)
        chosen = choose_nights(given.paths, nights, night, frames.rejects)
        sources = source_table(frames.sources, settings)
        check_sources(out, chosen, sources, replace)
        run_key = [*frames.sensors, *sorted(log.sha256 for log in frames.sources)]
        staged: dict[str, Path] = {}
        with lock_nights(out, [] if night else chosen) as staging, ExitStack() as folders:
            for date in chosen:
                if len(chosen) > 1:
                    LOGGER.info("night %s", date)
                made = gave_something(frames.sources, frames.rejects, date)
                recipe = recipe_of(night_logs_key(given, date, made), settings, known_key)
                work = work_folder(work_root(out), date, recipe, settings.work.keep, run_key)
                folder = folders.enter_context(work)
                rejects = into_nights(
                    concat(REJECTS, [given.rejects, frames.rejects]), nights, date
                )
                of_run = {"sources": sources, "rejects": rejects}
                earlier = EarlierNights(out, staged)
                folder_of_night = staging / f"night={date}"
                stage_night(frames, date, folder, of_run, earlier, catalogue, recipe,
                            folder_of_night, settings)  # fmt: skip
                staged[date] = folder_of_night
            summary = publish(Destination(out, staged, replace), sources)
            summary = with_reports(summary, staged, settings.report.write)
    LOGGER.info("published %s", ", ".join(f"{out.rstrip('/')}/night={date}" for date in chosen))
    return summary


def stage_night(
    frames: OrderedFrames, date: str, folder: WorkFolder, of_run: Mapping[str, pa.Table],
    earlier: EarlierNights, catalogue: KnownObjects | None, recipe: Recipe, staged: Path,
    settings: Settings,
) -> None:  # fmt: skip
    """Make a night from the frames of a run, and write its tables to the folder `staged`.

    `of_run` are its tables `sources` and `rejects`.
    """
    made = make_night(frames, date, folder, earlier.usual_sensors(date), settings)
    earlier_key = earlier.key(date, settings)
    names = name(made.work, made.solved, date, earlier.last_views(date), settings)
    elements, unused = choose_elements(catalogue, date, settings)
    rejects = concat(REJECTS, [of_run["rejects"], made.rejects, unused])
    tables = {**of_run, **made.tables, "rejects": rejects}
    linked = write_night(made.work, made.solved, date, names, tables, staged, settings)
    verdicts = determine_orbits(staged, date, linked)
    before = earlier.last_objects(date, settings)
    residuals = name_known(staged, elements, before, settings)
    list_objects(staged, date, verdicts)
    faults = [verdict for verdict in made.work.verdicts if verdict.is_faulty]
    write_night_row(staged, recipe, earlier_key, faults, residuals)


class MadeNight(NamedTuple):
    """The solved objects of a night; `tables` (by name) and `rejects` that belong to no span."""

    work: Work
    solved: SolvedParts
    tables: Mapping[str, pa.Table]
    rejects: pa.Table


def make_night(
    frames: OrderedFrames, night: str, folder: WorkFolder, usual: Sequence[str], settings: Settings
) -> MadeNight:
    """Turn the frames of a night, and of half an hour before and after it, into solved objects.

    The result does not depend on the other nights of the run. Only the check for missing sensors
    does: `usual` are those of nights before.
    """
    folder_of_night = frames.folder._replace(day=day_of(night))
    frames = frames._replace(folder=folder_of_night, cameras=cameras_of_night(frames, night))
    checks = check_logs(frames, night, usual, settings)
    spans, left_out = plan_spans(frames, night, wrong_velocities(checks))
    work = identify(frames, spans, folder, settings)
    work, stated = find_cameras(work, settings)
    work, calibrations = calibrate(work, stated, settings)
    checks = check_star_scatter(work, checks)
    while True:
        work = track(work, night, settings)
        solved = solve(work, settings)
        checked = check(work, solved, settings)
        if not checked.again:
            break
        work = checked.work  # back to `track`, with corrected times
    settled = settle(work, solved, checked, settings)
    checks = check_readings(settled, frames, checks)
    tables = {"checks": checks, "calibrations": calibrations}
    return MadeNight(settled.work, settled.solved, tables, left_out)


def choose_nights(
    logs: Sequence[str], nights: Sequence[str], night: str | None, rejects: pa.Table
) -> list[str]:
    """Return the nights to publish: all that the logs have frames of, or the one asked for."""
    if not nights:
        kind, when = (LogError, "") if night is None else (NoFramesError, f" on {night}")
        raise kind(f"{', '.join(logs)}: no frames{when} in these logs; {_advice(rejects)}")
    if night is None:
        return list(nights)
    if night not in nights:
        raise NoFramesError(f"no frames on {night} in these logs; they have {', '.join(nights)}")
    return [night]


def _advice(rejects: pa.Table) -> str:
    left_out = ", ".join(
        f"{reason} {count}"
        for reason, count in by_reason(rejects).items()
        if reason != Reason.NOTHING_READ
    )
    if left_out:
        return f"left out: {left_out}; check the recording"
    return "record epipole.CentroidFrame messages (the schema's name decides, not the topic)"
