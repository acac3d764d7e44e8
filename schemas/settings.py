"""The settings: one frozen group a stage, validated, each field with its unit in its name.

They come from a TOML file and from flow parameters, and are passed in, never read from
a global.
"""

import hashlib
import tomllib
from typing import TYPE_CHECKING, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from epipole.schemas.errors import SettingsError
from epipole.schemas.methods import ASSOCIATION, STAR_IDENTIFICATION, TRACK_LINKING

if TYPE_CHECKING:
    StarMethod = str
    LinkMethod = str
    AssociationMethod = str
else:  # the names that the registries list
    StarMethod = Literal[tuple(STAR_IDENTIFICATION)]
    LinkMethod = Literal[tuple(TRACK_LINKING)]
    AssociationMethod = Literal[tuple(ASSOCIATION)]


class Group(BaseModel):
    """A group of settings: frozen, and an unknown name is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SensorSettings(Group):
    """What to assume of a sensor where its log does not say."""

    attitude_sigma_arcsec: float = Field(60.0, gt=0, description="Prior attitude without sigma.")
    position_sigma_km: float = Field(0.05, gt=0, description="Position without sigma.")
    centroid_sigma_px: float | None = Field(
        None, gt=0, description="Centroids without sigma; none: estimated from the stars."
    )
    state_gap_s: float = Field(
        30.0, gt=0, description="A frame further than this from any state has no position."
    )


class IdentificationSettings(Group):
    """Star identification and attitude."""

    method: StarMethod = Field(
        "likelihood",
        description="How stars are identified; the others are published methods, for comparison.",
    )
    catalogue: str = Field(
        "hipparcos",
        min_length=1,
        description='Stars: "hipparcos", or the path of a file of `epipole catalog build`.',
    )
    magnitude_limit: float | None = Field(
        None, description="Faintest star looked for; none: from the number of centroids."
    )
    merge_px: float = Field(
        2.0, ge=0, description="Stars closer than this are one spot, with the brighter one's id."
    )
    gate_sigma: float = Field(3.7, gt=0, description="A star lies within this of its place.")
    false_alarm: float = Field(
        1e-5, gt=0, lt=1, description="Accepted probability that a reported attitude is by chance."
    )
    time_limit_s: float = Field(0.5, gt=0, description="Longest search for one frame.")
    calibrate: Literal["use", "report", "off"] = Field(
        "use",
        description="Optics from the night's stars: use them where they depart from the log's "
        "calibration, only report them, or neither.",
    )


class TrackletSettings(Group):
    """Detections of one sensor, frame after frame."""

    gate_sigma: float = Field(4.0, gt=0, description="A detection continues a track within this.")
    max_rate_deg_s: float = Field(2.0, gt=0, description="Fastest apparent motion looked for.")
    max_missed: int = Field(3, ge=0, description="Frames an object may be missed in a row.")
    min_detections: int = Field(3, ge=2, description="Shortest run that is an object.")
    false_alarm: float = Field(
        1e-4, gt=0, lt=1, description="Accepted runs made of strays, a frame."
    )
    link_method: LinkMethod = Field("likelihood_ratio", description="How broken tracks are joined.")
    link_gap_s: float = Field(90.0, gt=0, description="Longest break that is joined.")
    link_kept: float = Field(
        0.9999, gt=0, lt=1, description="Share of true joins that the chi-square test lets pass."
    )
    link_noise_px: float = Field(
        1e-3,
        gt=0,
        description="Process noise of the method 'prediction': px^2/s^3 across the gap.",
    )


class AlignmentSettings(Group):
    """Common instants of sensors that expose at different times."""

    interval_s: float | None = Field(
        None, gt=0, description="Between epochs; none: the slowest sensor's frame interval."
    )
    window_s: float = Field(
        6.0, gt=0, description="Half-width of the local motion fitted around an epoch."
    )
    max_gap_s: float | None = Field(
        None,
        gt=0,
        description="Farthest frame that serves an epoch; none: half its frame interval, or half "
        "the interval between epochs where that is longer.",
    )
    correct_clocks: bool = Field(
        False,
        description="Put frames at their true times where a sensor's clock is surely off; or else "
        "the sensor is left out.",
    )


class AltitudeShell(Group):
    """Heights above the equator's radius at which a share of all objects is."""

    lowest_km: float = Field(ge=0, description="Lower edge.")
    highest_km: float = Field(gt=0, description="Upper edge.")
    share: float = Field(gt=0, lt=1, description="Share of all objects that are in between.")


LOW_ORBITS = AltitudeShell(lowest_km=200, highest_km=2000, share=0.35)
NAVIGATION_ORBITS = AltitudeShell(lowest_km=19000, highest_km=24500, share=0.1)
# The protected region of the geostationary ring (IADC: 200 km either side), and its core.
GEOSTATIONARY_REGION = AltitudeShell(lowest_km=35586, highest_km=35986, share=0.2)
GEOSTATIONARY_RING = AltitudeShell(lowest_km=35746, highest_km=35826, share=0.2)


class AssociationSettings(Group):
    """Which views of different sensors are one object."""

    method: AssociationMethod = Field(
        "likelihood",
        description="How views are associated; the other is a published method, for comparison.",
    )
    threshold_px: float = Field(
        8.0,
        gt=0,
        description="Method 'epipolar': farthest from a line; published best are 8 to 12 px.",
    )
    gate_sigma: float = Field(4.5, gt=0, description="Views of one object agree within this.")
    min_altitude_km: float = Field(100.0, ge=0, description="Lowest object looked for.")
    max_range_km: float = Field(1.0e5, gt=0, description="Farthest object looked for.")
    span_s: float = Field(30.0, gt=0, description="Evidence is summed over spans of this length.")
    longest_span_s: float = Field(
        600.0,
        ge=0,
        description="What is not sure then is judged again over 2 and over 10 minutes, no longer "
        "than this; 0: never.",
    )
    shells: tuple[AltitudeShell, ...] = Field(
        (LOW_ORBITS, NAVIGATION_ORBITS, GEOSTATIONARY_REGION, GEOSTATIONARY_RING),
        description="A weak prior on altitude: where objects are more likely; empty: off.",
    )
    min_log_odds: float = Field(
        0.5, description="An object is reported if it is this much likelier than chance (ln)."
    )
    ambiguity_log_odds: float = Field(
        2.0, ge=0, description="Where a rival comes closer than this (ln), neither is reported."
    )


class PositionSettings(Group):
    """Least-squares positions."""

    reject_sigma: float = Field(4.0, gt=0, description="A view further off than this is rejected.")


class StateSettings(Group):
    """Positions and velocities over arcs."""

    arc_s: float = Field(
        600.0, gt=0, description="Longest arc of one state; arcs end at half hours too."
    )
    min_epochs: int = Field(
        3, ge=2, description="Fewest epochs that share no detection: two alone cannot be checked."
    )
    link_gap_s: float = Field(
        7200.0,
        ge=0,
        description="Longest time unseen after which an object is known again by its motion: "
        "more than half a low orbit, for which its sensors may look elsewhere; 0: never.",
    )
    link_log_odds: float = Field(
        4.6,
        gt=0,
        description="It must be this much likelier (ln) the same than another one: 1 in 100 errs.",
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

    def key(self) -> str:
        """Return a digest that is the same for the same settings."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:16]


def parse_settings(text: str, where: str) -> Settings:
    """Return the settings of a TOML text; `where` names it in messages.

    Raises
    ------
    SettingsError
        Names the setting, what came and what was expected.
    """
    try:
        return validate_settings(tomllib.loads(text), where)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{where}: not TOML: {error}") from error


def validate_settings(values: dict[str, Any], where: str) -> Settings:
    """Return the settings of nested mappings, such as flow parameters; see `parse_settings`."""
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        raise SettingsError(f"{where}: {_first_fault(error)}") from error


def _first_fault(error: ValidationError) -> str:
    fault = error.errors()[0]
    name = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        return f"unknown setting {name}; `epipole settings` lists them all"
    return f"{name} = {fault['input']!r}: {fault['msg'][0].lower()}{fault['msg'][1:]}"
