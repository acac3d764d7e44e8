"""The settings of a run: one frozen, validated group per subject.

They come from a TOML file or from flow parameters. They are passed in, never read from a global.
"""

import hashlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from epipole.schemas.log_bounds import ATTITUDE_SIGMA, LINE_TIME, POSITION_SIGMA
from epipole.schemas.options import (
    ASSOCIATION,
    DEFAULT_CATALOGUE,
    STAR_CATALOGUES,
    STAR_IDENTIFICATION,
    TRACK_LINKING,
)

_BUILT_IN = ", ".join(f'"{name}"' for name, source in STAR_CATALOGUES.items() if source.for_runs)

if TYPE_CHECKING:
    StarMethod = str
    LinkMethod = str
    AssociationMethod = str
else:  # the names that the registries list
    StarMethod = Literal[tuple(STAR_IDENTIFICATION)]
    LinkMethod = Literal[tuple(TRACK_LINKING)]
    AssociationMethod = Literal[tuple(ASSOCIATION)]


# Bounds beyond which no sensor and no object is; a larger value is a slip of the pen.
DAY_S = 86_400
FARTHEST_KM = 1e6  # twice as far as the Moon
MAX_SIGMA = 100
MAX_LOG_ODDS = 1000
BYTES_PER_VIEW = 2000  # of memory, where positions are solved


class Group(BaseModel):
    """A frozen group of settings. An unknown name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


EVERY_SENSOR = "*"


class Assumption(Group):
    """How a sensor's log is read, in place of what it states: the cure of a mistake in it."""

    sensor: str = Field(
        EVERY_SENSOR, min_length=1, max_length=63, description="Its id; `*`: every sensor."
    )
    time: Literal["utc", "gps", "tai"] = Field(
        "utc", description="Time scale of its frames, states and calibrations."
    )
    ahead_s: float = Field(
        0.0,
        ge=-DAY_S,
        le=DAY_S,
        description="By how much these times are ahead of their time scale, such as 3600 for "
        "local time.",
    )
    frames_ahead_s: float = Field(
        0.0,
        ge=-DAY_S,
        le=DAY_S,
        description="By how much times of its frames are ahead of those of its states, besides.",
    )
    frame_time: Literal["middle", "start", "end"] = Field(
        "middle", description="Which instant of the exposure a frame's time is."
    )
    states: Literal["as stated", "GCRF", "EME2000", "TEME", "ITRF"] = Field(
        "as stated", description="Reference frame of its states."
    )
    velocities: Literal["as stated", "unknown"] = Field(
        "as stated", description="Unknown: they come from its positions."
    )
    position_unit: Literal["km", "m"] = Field("km", description="Unit of its positions.")
    position_sigma_unit: Literal["km", "m"] = Field("km", description="Unit of their sigmas.")
    velocity_unit: Literal["km/s", "m/s"] = Field("km/s", description="Unit of its velocities.")
    line_time_s: float | None = Field(
        None,
        ge=LINE_TIME.minimum,
        le=LINE_TIME.maximum,
        description="Rolling shutter of its calibrations: time from the exposure of one row to "
        "that of the next. Default: as stated.",
    )


class SensorSettings(Group):
    """Values that are used where a log lacks them."""

    attitude_sigma_arcsec: float = Field(
        60.0,
        gt=0,
        le=ATTITUDE_SIGMA.maximum,
        description="1-sigma of a prior attitude that has no sigma in the log.",
    )
    position_sigma_km: float = Field(
        0.05,
        gt=0,
        le=POSITION_SIGMA.maximum,
        description="1-sigma of a position that has no sigma in the log.",
    )
    centroid_sigma_px: float | None = Field(
        None,
        gt=0,
        le=100,
        description="1-sigma of a centroid that has no sigma in the log. "
        "Default: estimated from the stars.",
    )
    principal_point_sigma_px: float | None = Field(
        None,
        ge=0,
        le=1000,
        description="1-sigma of the principal point of a calibration, per axis: part of the sigma "
        "of each attitude, as an error that all frames of a sensor share. Default: 0 where the "
        "stars do not contradict the calibration, half a percent of the image's size where they "
        "do.",
    )
    state_gap_s: float = Field(
        30.0,
        gt=0,
        le=DAY_S,
        description="A frame farther than this from the nearest state gets no position.",
    )
    assume: tuple[Assumption, ...] = Field(
        (),
        description="How logs are read in place of what they state, where they were written "
        'otherwise: `{ sensor = "sat1", time = "gps" }` each. `sensor` is an id, or `*` for every '
        "sensor; `time` is utc, gps or tai; `ahead_s` seconds by which these times are ahead "
        "besides, `frames_ahead_s` those of frames alone; `frame_time` the middle, start or end of "
        "the exposure; `states` GCRF, EME2000, TEME or ITRF; `position_unit` and "
        "`position_sigma_unit` km or m, `velocity_unit` km/s or m/s; `velocities` unknown; "
        "`line_time_s` seconds from row to row. A sensor takes all that name it.",
    )
    expected: tuple[str, ...] | None = Field(
        None,
        description="Ids of the sensors that each night should have frames of; one that has none "
        "needs a look. Default: those that half of the nights of the 30 days before have.",
    )
    max_gaps: float = Field(
        0.02,
        ge=0,
        le=1,
        description="Largest share of the night, from its first to its last frame, in which a "
        "sensor may have no frames; with more it needs a look.",
    )


class IdentificationSettings(Group):
    """Star identification and attitude."""

    method: StarMethod = Field(
        "likelihood",
        description="How stars are identified. The methods other than likelihood are published "
        "ones, for comparison.",
    )
    catalogue: str = Field(
        DEFAULT_CATALOGUE,
        min_length=1,
        description=f"Stars: {_BUILT_IN}, or the path of a file of `epipole catalog build`.",
    )
    magnitude_limit: float | None = Field(
        None,
        ge=-2,
        le=25,
        description="Faintest star to search for. Default: from the number of centroids.",
    )
    merge_px: float = Field(
        2.0,
        ge=0,
        le=100,
        description="Stars closer than this make one spot. It gets the id of the brighter star.",
    )
    gate_sigma: float = Field(
        3.7,
        gt=0,
        le=MAX_SIGMA,
        description="Largest distance of a centroid from the predicted position of its star.",
    )
    false_alarm: float = Field(
        1e-5,
        gt=0,
        lt=1,
        description="Accepted share of false attitudes: of all frames of a sensor; if half or more "
        "show no stars, of those.",
    )
    time_limit_s: float = Field(
        0.5,
        gt=0,
        le=3600,
        description="Limit of the searches of one frame, in seconds of a reference machine: work "
        "is counted. Averaged over a sensor's frames they may take a tenth of it. Frames that are "
        "not searched to the end for it have the status `search_limit` or `time_limit`.",
    )
    calibrate: Literal["use", "report", "off"] = Field(
        "use",
        description="The optics are also fitted to the stars of the night. 'use' takes the fitted "
        "optics where they differ from the log's calibration, 'report' only publishes them, "
        "'off' does neither.",
    )


class TrackletSettings(Group):
    """How detections of one sensor are joined to tracklets."""

    gate_sigma: float = Field(
        4.0,
        gt=0,
        le=MAX_SIGMA,
        description="Largest distance of a detection from the prediction of its track.",
    )
    max_rate_deg_s: float = Field(
        12.0, gt=0, le=180, description="Fastest apparent motion to search for."
    )
    max_missed: int = Field(
        3,
        ge=0,
        le=1000,
        description="Most frames in a row in which a tracklet may have no detection; up to 24 if "
        "it moves so evenly that a false detection in its gate is improbable.",
    )
    min_detections: int = Field(
        3,
        ge=2,
        le=1000,
        description="Minimum number of detections of a tracklet. Two alone never make one.",
    )
    false_alarm: float = Field(
        1e-4, gt=0, lt=1, description="Accepted number of false tracklets per frame."
    )
    false_alarm_sequence: float = Field(
        1.0,
        gt=0,
        le=1000,
        description="Accepted number of false tracklets in a sequence of at most 24 frames (with "
        "the default `min_detections`): detections that are in no tracklet are followed again with "
        "it. Every pair of detections counts as a test, so it is an upper bound: 1 to 5 % of it "
        "was measured.",
    )
    max_detections: int = Field(
        500_000,
        ge=1_000,
        le=1_000_000_000,
        description="Maximum number of detections of a sensor in half an hour that are followed; "
        "of more, the fullest frames keep the brightest. It bounds the memory of a task: about "
        "1 kB each.",
    )
    link_method: LinkMethod = Field(
        "likelihood_ratio", description="How tracklets of one object are joined after a gap."
    )
    link_gap_s: float | None = Field(
        None,
        gt=0,
        le=DAY_S,
        description="Longest gap across which tracklets are joined. Default: as far as their "
        "motion can be predicted; three minutes where the gap lies over the end of a span.",
    )
    link_kept: float = Field(
        0.9999, gt=0, lt=1, description="Share of true links that the chi-square test accepts."
    )
    link_noise_px: float = Field(
        1e-3,
        gt=0,
        le=1000,
        description="Process noise of the method 'prediction', in px^2/s^3.",
    )


class AlignmentSettings(Group):
    """Common epochs of sensors that expose at different times."""

    interval_s: float | None = Field(
        None,
        ge=1e-3,
        le=DAY_S,
        description="Time between epochs. Default: the frame interval of the slowest sensor.",
    )
    window_s: float = Field(
        6.0,
        gt=0,
        le=3600,
        description="Half-width of the time window in which the motion around an epoch is fitted.",
    )
    max_gap_s: float | None = Field(
        None,
        gt=0,
        le=DAY_S,
        description="Longest time between an epoch and the frame used for it. Default: half the "
        "frame interval or half the interval between epochs, whichever is longer.",
    )
    correct_clocks: bool = Field(
        True,
        description="What to do with a sensor whose clock is certainly wrong: true corrects the "
        "times of its frames, false adds an error as large to its positions.",
    )


class AltitudeShell(Group):
    """Altitudes (above the equatorial radius) that hold a share of all objects."""

    lowest_km: float = Field(ge=0, le=FARTHEST_KM, description="Lower altitude.")
    highest_km: float = Field(gt=0, le=FARTHEST_KM, description="Upper altitude.")
    share: float = Field(gt=0, lt=1, description="Share of all objects between them.")


LOW_ORBITS = AltitudeShell(lowest_km=200, highest_km=2000, share=0.35)
NAVIGATION_ORBITS = AltitudeShell(lowest_km=19000, highest_km=24500, share=0.1)
# The protected region around the geostationary altitude (IADC: 200 km on both sides), and its core.
GEOSTATIONARY_REGION = AltitudeShell(lowest_km=35586, highest_km=35986, share=0.2)
GEOSTATIONARY_RING = AltitudeShell(lowest_km=35746, highest_km=35826, share=0.2)


class AssociationSettings(Group):
    """Which tracklets of different sensors show one object."""

    method: AssociationMethod = Field(
        "likelihood",
        description="How tracklets are associated. 'epipolar' is a published method, for "
        "comparison.",
    )
    threshold_px: float = Field(
        8.0,
        gt=0,
        le=10_000,
        description="Method 'epipolar': largest distance of a view from the epipolar line. "
        "Published values are 8 to 12 px.",
    )
    gate_sigma: float = Field(
        4.5, gt=0, le=MAX_SIGMA, description="Largest disagreement between views of one object."
    )
    min_altitude_km: float = Field(
        100.0, ge=0, le=FARTHEST_KM, description="Altitude of the lowest object to search for."
    )
    max_range_km: float = Field(
        1.0e5, gt=0, le=FARTHEST_KM, description="Range of the farthest object to search for."
    )
    window_s: float = Field(
        30.0,
        ge=1,
        le=3600,
        description="Length of the windows of time over which evidence is first summed.",
    )
    max_window_s: float = Field(
        600.0,
        ge=0,
        le=DAY_S,
        description="Undecided tracklets are judged again over windows of 2 and then 10 minutes, "
        "up to this length. 0: never.",
    )
    shells: tuple[AltitudeShell, ...] = Field(
        (LOW_ORBITS, NAVIGATION_ORBITS, GEOSTATIONARY_REGION, GEOSTATIONARY_RING),
        description="A weak prior: the altitudes at which objects are more likely. Empty: no "
        "prior.",
    )
    min_log_odds: float = Field(
        2.0,
        ge=-MAX_LOG_ODDS,
        le=MAX_LOG_ODDS,
        description="Minimum log-odds (ln) of a reported object against chance.",
    )
    ambiguity_log_odds: float = Field(
        2.0,
        ge=0,
        le=MAX_LOG_ODDS,
        description="Minimum difference in log-odds (ln) between two rival hypotheses. Below it, "
        "neither is reported.",
    )


class PositionSettings(Group):
    """Positions of objects at epochs, by least squares."""

    reject_sigma: float = Field(
        4.0, gt=0, le=MAX_SIGMA, description="Largest residual of a view that is used."
    )
    all_pairs: bool = Field(
        False,
        description="Whether `pairs` has every two views of an object at an epoch, or each view "
        "with its reference view only. Their number grows with the square of the sensors.",
    )


class StateSettings(Group):
    """States (position and velocity) of objects over arcs, and objects that are seen again."""

    arc_s: float = Field(
        600.0,
        gt=0,
        le=DAY_S,
        description="Longest arc of one state. Arcs also end at every half hour.",
    )
    min_epochs: int = Field(
        3,
        ge=2,
        le=1000,
        description="Minimum number of independent epochs of an arc. A state from only two cannot "
        "be checked.",
    )
    link_gap_s: float = Field(
        7200.0,
        ge=0,
        le=7 * DAY_S,
        description="Longest time without detections after which an object is recognised by its "
        "motion. The default is more than half a low orbit. 0: never.",
    )
    link_log_odds: float = Field(
        4.6,
        gt=0,
        le=MAX_LOG_ODDS,
        description="Least log-odds (ln) that it is the same object. At the default, 1 in 100 "
        "links is wrong.",
    )


class LinkingSettings(Group):
    """Tracklets of different times that are joined by one orbit."""

    enabled: bool = Field(True, description="Whether tracklets are joined by orbits.")
    max_gap_s: float = Field(
        2400.0,
        gt=0,
        le=2400,
        description="Longest time between two tracklets that are compared. Less than half a low "
        "orbit: beyond it, an object may have passed once more.",
    )
    max_orbit_gap_s: float = Field(
        10800.0,
        ge=0,
        le=43200,
        description="Longest time between an object of several tracklets and another, or a single "
        "tracklet, that are compared by its orbit. 0: none are.",
    )
    log_odds: float = Field(
        7.0,
        gt=0,
        le=MAX_LOG_ODDS,
        description="Least log-odds (ln) that tracklets are one object; of two alone that are less "
        "than two minutes apart, 2 more. At the default, less than 1 in 10,000 links is wrong.",
    )


class KnownObjectSettings(Group):
    """Objects compared with a catalogue of known ones, and with earlier nights."""

    probability: float = Field(
        0.99, gt=0.5, lt=1, description="Minimum probability of a name that is given to an object."
    )
    max_days: float = Field(
        30.0,
        gt=0,
        le=3660,
        description="Element sets whose epoch is farther from the night are not used [days].",
    )
    earlier_h: float = Field(
        36.0,
        ge=0,
        le=240,
        description="Longest time without detections after which an unknown object is recognised "
        "as one of an earlier night [hours]. 0: never.",
    )


class WorkSettings(Group):
    """How the work of a night is divided."""

    memory_mib: int = Field(
        384,
        ge=64,
        le=16 * 1024**2,
        description="Memory that a task of `solve` takes at most, about [MiB]. Nights of many "
        "sensors are divided into more tasks; the objects stay the same.",
    )
    keep: bool = Field(
        False,
        description="Whether the tables of the work of a night are kept: a run of the same night "
        "with more logs then makes only what they change. They take 0.7 kB per detection.",
    )

    @property
    def max_views(self) -> int:
        """The limit of the views that a task has in memory at the same time."""
        return self.memory_mib * 2**20 // BYTES_PER_VIEW


class TableSettings(Group):
    """What is left out of the largest tables. Nothing else depends on it."""

    stars_every: int = Field(
        1,
        ge=0,
        le=1_000_000,
        description="The stars of every N-th frame of a sensor are published: 1: of all frames, "
        "0: of none. They are nine tenths of a dataset.",
    )
    detections: Literal["all", "tracked"] = Field(
        "all",
        description="Which detections are published: 'all', or 'tracked': only those of tracklets "
        "and objects.",
    )


class ReportSettings(Group):
    """The report of a night: a page with pictures. It changes no table."""

    write: bool = Field(
        True,
        description="Whether a run writes `reports/DATE.html` into the dataset. Without matplotlib "
        "(the extra `report`) it writes none.",
    )


class Settings(Group):
    """All settings of a run."""

    sensors: SensorSettings = SensorSettings()
    identification: IdentificationSettings = IdentificationSettings()
    tracklets: TrackletSettings = TrackletSettings()
    alignment: AlignmentSettings = AlignmentSettings()
    association: AssociationSettings = AssociationSettings()
    positions: PositionSettings = PositionSettings()
    states: StateSettings = StateSettings()
    linking: LinkingSettings = LinkingSettings()
    known_objects: KnownObjectSettings = KnownObjectSettings()
    work: WorkSettings = WorkSettings()
    tables: TableSettings = TableSettings()
    report: ReportSettings = ReportSettings()

    @model_validator(mode="after")
    def _agree(self) -> Self:
        """Refuse settings that contradict each other."""
        if (contradiction := _contradiction(self)) is not None:
            raise ValueError(contradiction)
        return self

    def changed(self) -> list[str]:
        """Return the settings that are not the defaults, such as ``sensors.max_gaps = 0.1``."""
        mine, usual = self.model_dump(), Settings().model_dump()
        return [
            f"{group}.{name} = {value!r}"
            for group, values in mine.items()
            for name, value in values.items()
            if value != usual[group][name]
        ]

    def key(self) -> str:
        """Return a digest of the settings that results depend on."""
        text = self.model_dump_json(exclude={"report": True, "work": {"keep"}})
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _contradiction(settings: Settings) -> str | None:
    """Return which settings contradict each other; None: none do."""
    association = settings.association
    for shell in association.shells:
        if shell.lowest_km >= shell.highest_km:
            return (
                f"association.shells: lowest_km = {shell.lowest_km:g} is not below "
                f"highest_km = {shell.highest_km:g}"
            )
    share = sum(shell.share for shell in association.shells)
    if share > 1:
        return f"association.shells: the shares add up to {share:.3g}, which is more than 1"
    if association.min_altitude_km >= association.max_range_km:
        return (
            f"association.min_altitude_km = {association.min_altitude_km:g} is not below "
            f"association.max_range_km = {association.max_range_km:g}"
        )
    return _assumed_twice(settings.sensors.assume)


# Of several assumptions of a sensor these would all be taken back, one after the other.
_ADD_UP = ("time", "frame_time", "position_unit", "position_sigma_unit", "velocity_unit")


def _assumed_twice(assumed: Sequence[Assumption]) -> str | None:
    """Return what is assumed of a sensor more than once; None: nothing is."""
    usual = Assumption()
    for name in _ADD_UP:
        of = [each.sensor for each in assumed if getattr(each, name) != getattr(usual, name)]
        if len(of) > (1 if EVERY_SENSOR in of else len(set(of))):
            return f"sensors.assume: {name} is assumed twice of a sensor ({', '.join(of)})"
    return None
