"""A simulation scene: sensors, objects and noise, from a TOML file.

A scene may leave values to chance (``count``, ``random`` orbits, the spread of objects). They are
then drawn with the scene's seed.
"""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self

from pydantic import AwareDatetime, Field, ValidationError, model_validator

from epipole.schemas.errors import SceneError
from epipole.schemas.log_bounds import LINE_TIME
from epipole.schemas.settings import Group
from epipole.schemas.text import toml_values

# Orbits: parameters and their bounds.

Vector = tuple[float, float, float]


_WALKER = r"^\d{1,3}(\.\d+)?:\d{1,5}/\d{1,4}/\d{1,4}$"


class SceneShell(Group):
    """A shell of a constellation: a Walker pattern of circular orbits at one altitude."""

    altitude_km: float = Field(gt=150, le=3000, description="Above the equatorial radius.")
    walker: str = Field(
        pattern=_WALKER,
        description="`i:t/p/f`: inclination in degrees, satellites, planes, and phasing between "
        'neighbouring planes in units of 360 / t degrees, such as "53:1584/72/39".',
    )
    arc_deg: float = Field(
        360.0,
        gt=0,
        le=360,
        description="Arc of the equator that the ascending nodes fill: 360 for a Walker delta "
        "pattern, 180 for a star of polar planes.",
    )

    @property
    def pattern(self) -> tuple[float, int, int, int]:
        """Return inclination [deg], satellites, planes and phasing."""
        inclination, rest = self.walker.split(":")
        t, p, f = map(int, rest.split("/"))
        return float(inclination), t, p, f

    @model_validator(mode="after")
    def _whole_planes(self) -> Self:
        inclination, t, p, f = self.pattern
        if inclination > 180 or not t or not p or t % p or f >= p:
            raise ValueError(
                f"walker {self.walker}: expected i <= 180, t a multiple of p, and f below p"
            )
        return self


class Orbit(Group):
    """An orbit about the Earth.

    By elements or by a position at the start of the scene, random, of a constellation, or of real
    satellites: by SGP4 from a file of published element sets. Those of a constellation, and
    random ones of the kind "low", move by SGP4 too.
    """

    a_km: float | None = Field(None, gt=6378.0, description="Semi-major axis.")
    e: float = Field(0.0, ge=0, lt=1, description="Eccentricity.")
    i_deg: float = Field(0.0, ge=0, le=180, description="Inclination.")
    raan_deg: float = Field(0.0, description="Right ascension of the ascending node.")
    argp_deg: float = Field(0.0, description="Argument of perigee.")
    mean_anomaly_deg: float | None = Field(None, description="Mean anomaly at the start.")
    true_anomaly_deg: float | None = Field(None, description="The true anomaly instead.")
    position_km: Vector | None = Field(None, description="GCRF position at the start.")
    velocity_km_s: Vector | None = Field(
        None, description="GCRF velocity there. Default: a circular orbit eastward."
    )
    random: Literal["leo", "low", "meo", "geo"] | None = Field(
        None,
        description='A random orbit of this kind. "low": the shells and inclinations in which low '
        "satellites are, for objects only.",
    )

    elements: str | None = Field(
        None,
        min_length=1,
        description="A file of element sets: two-line elements, or OMM in JSON, CSV or XML. A "
        "relative path starts at the folder of the scene file, or is a file of the package.",
    )
    satellites: list[str | int] = Field(
        [], description="Names or catalogue numbers to take from the file. Default: all."
    )
    usable_only: bool = Field(
        False,
        description="elements: leave out satellites whose elements are too old or that SGP4 "
        "fails for, instead of refusing the scene.",
    )

    shells: list[SceneShell] = Field(
        [],
        description="A constellation. Groups with the same shells and count are on the same "
        "satellites, called s001 and so on.",
    )
    scatter_km: float = Field(
        0.0, ge=0, le=100, description="shells: 1-sigma per axis about the regular pattern."
    )
    near: bool = Field(
        False,
        description="shells: take the satellites nearest to a random one in the middle of the "
        "scene. Default: some at random from all of the pattern.",
    )

    @property
    def is_of_satellites(self) -> bool:
        """Return whether the orbit is of several satellites: of a file, or a constellation."""
        return self.elements is not None or bool(self.shells)

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        ways = (self.a_km, self.position_km, self.random, self.elements, self.shells or None)
        if sum(way is not None for way in ways) != 1:
            raise ValueError("an orbit takes one of a_km, position_km, random, elements and shells")
        goes = {"elements": {"satellites", "usable_only"}, "shells": {"scatter_km", "near"}}
        for way, names in goes.items():
            others = self.model_fields_set - names - {way}
            if not getattr(self, way):
                for name in sorted(self.model_fields_set & names):
                    raise ValueError(f"{name} goes with {way}")
            elif others:
                raise ValueError(f"{min(others)} does not go with {way}")
        if self.mean_anomaly_deg is not None and self.true_anomaly_deg is not None:
            raise ValueError("an orbit takes mean_anomaly_deg or true_anomaly_deg, not both")
        if self.position_km is not None and not any(self.position_km[:2]):
            raise ValueError("position_km lies on the Earth's axis")
        if self.velocity_km_s is not None and self.position_km is None:
            raise ValueError("velocity_km_s goes with position_km")
        if self.a_km is not None and self.a_km * (1 - self.e) < 6378.0:
            raise ValueError("the orbit's perigee lies below the ground")
        return self


# The scene.

_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,62}$"


class LensDeparture(Group):
    """How the true optics differ from the calibration in the log: true minus log."""

    focal: float = Field(0.0, gt=-0.5, lt=0.5, description="Relative error of the focal length.")
    cx_px: float = 0.0
    cy_px: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0


class SceneCamera(Group):
    """The optics of a sensor, as the log reports them."""

    width: int = Field(1024, ge=16, le=65536)
    height: int = Field(1024, ge=16, le=65536)
    fov_deg: float | None = Field(None, gt=0, lt=150, description="Full field of view along x.")
    focal_px: float | None = Field(None, gt=0, description="The focal length instead.")
    cx_px: float | None = Field(
        None, description="Principal point. Default: the middle of the image."
    )
    cy_px: float | None = None
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    fisheye: bool = Field(
        False,
        description="Without distortion, the distance from the principal point is the angle from "
        "the boresight times the focal length (ROS's equidistant).",
    )
    line_time_s: float = Field(
        0.0,
        ge=LINE_TIME.minimum,
        le=LINE_TIME.maximum,
        description="Rolling shutter: time from the exposure of one row to that of the next. The "
        "middle row has the frame's time.",
    )
    departure: LensDeparture = LensDeparture()

    @model_validator(mode="after")
    def _one_scale(self) -> Self:
        if (self.fov_deg is None) == (self.focal_px is None):
            raise ValueError("a camera takes one of fov_deg and focal_px")
        return self

    @model_validator(mode="after")
    def _terms_of_a_log(self) -> Self:
        if self.fisheye and (self.p1 or self.p2):
            raise ValueError("p1 and p2 do not go with a fisheye: its calibration has k1 to k4")
        if self.k4 and not self.fisheye:
            raise ValueError("k4 goes with a fisheye: a pinhole's calibration has k1, k2 and k3")
        return self


class Pointing(Group):
    """The pointing of a sensor."""

    mode: Literal["track", "fixed", "spin", "body", "random"] = "track"
    orbit: Orbit | None = Field(None, description="track: the orbit to follow.")
    target: Annotated[int, Field(ge=0)] | str | None = Field(
        None,
        description="track: the object of the scene to follow instead, by its number or name.",
    )
    place_km: Vector | None = Field(
        None, description="track: the GCRF position to follow instead; it does not move."
    )
    up: Vector = Field(
        (0.0, 0.0, 1.0),
        description="track, fixed, spin: inertial direction that is up in the image.",
    )
    roll_deg: float = Field(
        0.0, description="All but random: rotation about the boresight after that."
    )
    azimuth_deg: float = Field(
        0.0,
        description="body: boresight in the orbital frame of the sensor, from along the motion "
        "towards across (the orbit's normal). Away from the Earth is up in the image.",
    )
    elevation_deg: float = Field(
        0.0, ge=-90, le=90, description="body: from the horizontal away from the Earth."
    )
    azimuth_from: Literal["motion", "anti_sun"] = Field(
        "motion",
        description="body: what the azimuth is counted from: the motion, or the horizontal away "
        "from the Sun at the start. It stays fixed to the body in either case.",
    )
    spread_deg: float = Field(
        0.0,
        ge=0,
        le=90,
        description="body: azimuth and elevation of each sensor differ by up to this, at random.",
    )
    ra_deg: float | None = Field(None, description="fixed, spin: boresight at the start.")
    dec_deg: float | None = Field(None, ge=-90, le=90)
    axis: Vector = Field((0.0, 0.0, 1.0), description="spin: inertial axis of rotation.")
    rate_deg_s: float = Field(0.0, description="spin: rate about the axis.")
    hold_s: float | None = Field(
        None, gt=0, description="random: time until the next jump. Default: one frame."
    )
    clear_of_earth_deg: float | None = Field(
        None,
        ge=0,
        le=60,
        description="random: least angle of the boresight above the Earth's limb.",
    )
    skip_hidden: bool = Field(
        False, description="No exposures while the Earth covers the boresight."
    )
    jitter_arcsec: float = Field(
        0.0, ge=0, description="1-sigma per axis, independent in each frame."
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        followed = (self.orbit, self.target, self.place_km)
        if self.mode == "track" and sum(way is not None for way in followed) != 1:
            raise ValueError('pointing "track" takes one of orbit, target and place_km')
        if self.mode in ("fixed", "spin") and (self.ra_deg is None or self.dec_deg is None):
            raise ValueError(f'pointing "{self.mode}" takes ra_deg and dec_deg')
        if not any(self.up) or not any(self.axis):
            raise ValueError("up and axis must not be zero")
        return self


class SceneDetection(Group):
    """Errors of the image processing: noise, losses and false points."""

    sigma_px: float = Field(0.15, gt=0, description="1-sigma per axis of a bright centroid.")
    faint_sigma_px: float = Field(
        0.0,
        ge=0,
        description="Added in quadrature at the magnitude limit, less at brighter magnitudes.",
    )
    send_sigma: bool = True
    send_flux: bool = True
    flux_error: float = Field(0.05, ge=0, lt=1, description="Relative, 1-sigma.")
    false_points: float = Field(0.0, ge=0, description="Mean number per frame (Poisson).")
    hot_pixels: int = Field(0, ge=0, description="Pixels that show a point in every frame.")
    star_drop: float = Field(0.0, ge=0, le=1, description="Share of stars missed.")
    target_drop: float = Field(0.0, ge=0, le=1, description="Share of objects missed.")
    fade: float = Field(
        0.0,
        ge=0,
        description="1-sigma width of the magnitude limit of objects, drawn anew in each frame. "
        "Default: a sharp limit.",
    )
    blend_px: float = Field(
        0.0,
        ge=0,
        le=20,
        description="Stars and objects nearer than this are one centroid at the middle of their "
        "light, and what is too faint alone counts. Default: only stars do so, within 2 px.",
    )
    trail_error: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="1-sigma along the motion of an object, relative to the length of its trail, "
        "beside `sigma_px`. It is not sent.",
    )


class SceneStates(Group):
    """The states of the sensor in the log, and their errors."""

    rate_hz: float = Field(1.0, gt=0)
    margin_s: float = Field(
        2.0, ge=0, description="Time covered by states before the first and after the last frame."
    )
    send_velocity: bool = True
    position_noise_km: float = Field(
        0.01, ge=0, description="1-sigma per axis, independent in each state."
    )
    position_bias_km: float = Field(
        0.02, ge=0, description="1-sigma per axis, constant for each sensor."
    )
    prior_noise_arcsec: float | None = Field(
        None,
        ge=0,
        description="1-sigma per axis of the attitude. Default: the log has no attitudes.",
    )
    prior_bias_arcsec: float = Field(
        0.0, ge=0, description="1-sigma per axis, constant for each sensor."
    )
    prior_share: float = Field(
        1.0, ge=0, le=1, description="Share of the satellites whose logs have attitudes."
    )


class SceneFaults(Group):
    """Errors of a sensor that are constant, and whether its log states them.

    A stated offset is part of the sigma in the states. Other offsets are not in the sigma. See
    `clock_offset_s` for the clock, for which a log has no sigma.
    """

    position_offset_km: float | Vector = Field(
        0.0,
        description="Reported minus true position, GCRF. One number is the size of an offset in a "
        "random direction.",
    )
    position_told: bool = False
    prior_offset_arcsec: float | Vector = Field(
        0.0,
        description="Rotation of the reported attitudes about the sensor's axes. One number is "
        "its size, about a random axis.",
    )
    prior_told: bool = False


class SceneSensor(Group):
    """One sensor, or several that differ in their random values or in their satellites."""

    id: str = Field(pattern=_NAME, description="With a count above 1, a number is appended.")
    count: int | None = Field(
        None,
        ge=1,
        le=10000,
        description="Default: 1, or one for each satellite of `orbit.elements` or "
        "`orbit.shells`. A smaller number takes some of these satellites at random.",
    )
    orbit: Orbit
    in_view: bool = Field(
        False,
        description="Take only random orbits or satellites from which the tracked object or "
        "position is always visible.",
    )
    camera: SceneCamera
    pointing: Pointing
    detection: SceneDetection = SceneDetection()
    states: SceneStates = SceneStates()
    faults: SceneFaults = SceneFaults()
    magnitude_limit: float = Field(
        7.5, description="V magnitude of the faintest star that is detected."
    )
    object_limit: float | None = Field(
        None, description="V magnitude of the faintest object. Default: that of stars."
    )
    rate_hz: float = Field(1.0, gt=0, le=1000)
    phase: float | None = Field(
        None,
        ge=0,
        lt=1,
        description="Time of the first frame, in frame intervals. Default: random.",
    )
    exposure_s: float = Field(0.1, gt=0)
    time_jitter_s: float = Field(0.0, ge=0, description="1-sigma of the time of a frame.")
    clock_offset_s: float = Field(
        0.0,
        gt=-60,
        lt=60,
        description="Reported minus true time of the frames. States have the true time.",
    )
    frame_drop: float = Field(0.0, ge=0, lt=1, description="Share of frames missing.")
    outages_s: list[tuple[float, float]] = Field(
        [], description="Start and end of intervals without frames, since the start."
    )


class SceneTargets(Group):
    """One object, several near the same orbit, or real satellites."""

    count: int | None = Field(
        None,
        ge=0,
        le=1000000,
        description="Default: 1, or one for each satellite of `orbit.elements` or "
        "`orbit.shells`. A smaller number takes some of these satellites at random.",
    )
    orbit: Orbit
    spread_km: float = Field(
        0.0, ge=0, description="1-sigma per axis about the position of the orbit at the start."
    )
    magnitude: float | tuple[float, float] = Field(
        8.0, description="A value, or the limits of a random one. The same at any distance."
    )
    standard_magnitude: float | tuple[float, float] | None = Field(
        None,
        description="Magnitude at 1000 km instead, a value or limits: 5 log10 of the distance "
        "is added.",
    )

    @model_validator(mode="after")
    def _one_magnitude(self) -> Self:
        if self.standard_magnitude is not None and "magnitude" in self.model_fields_set:
            raise ValueError("an object takes magnitude or standard_magnitude, not both")
        if self.spread_km and (self.orbit.is_of_satellites or self.orbit.random == "low"):
            raise ValueError("spread_km does not go with satellites that move by SGP4")
        return self


class Scene(Group):
    """A scene to simulate."""

    name: str = Field(pattern=_NAME)
    # Those of `log_bounds`, with room for the states about a scene of a month.
    start: Annotated[
        AwareDatetime,
        Field(ge=datetime(1972, 1, 2, tzinfo=UTC), lt=datetime(2099, 11, 1, tzinfo=UTC)),
    ] = datetime(2019, 4, 1, 4, tzinfo=UTC)
    duration_s: float = Field(60.0, gt=0, le=31 * 86400)
    seed: int = Field(1, ge=0)
    sensors: list[SceneSensor] = Field(min_length=1)
    targets: list[SceneTargets] = Field([], description="Objects or groups of objects.")
    catalogue: str = Field(
        "hipparcos",
        min_length=1,
        description='Stars: "hipparcos", or the path of a file of `epipole catalog build`.',
    )
    element_age_days: float = Field(
        14.0,
        gt=0,
        description="Element sets farther than this from the scene are refused: after two weeks "
        "SGP4 is tens of kilometres off for a low orbit.",
    )
    earth_shadow: bool = Field(
        False, description="Objects in the Earth's shadow (a cylinder) are not seen."
    )
    phase_law: bool = Field(
        False,
        description="Objects are diffuse spheres lit by the Sun: magnitudes hold where they are "
        "fully lit.",
    )

    @model_validator(mode="after")
    def _no_low_sensors(self) -> Self:
        if low := [s.id for s in self.sensors if s.orbit.random == "low"]:
            raise ValueError(f'sensor {low[0]}: random = "low" is for objects')
        return self

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        names = [s.id for s in self.sensors]
        if len(set(names)) < len(names):
            raise ValueError("two sensors have the same id")
        counts = [
            1 if g.count is None and not g.orbit.is_of_satellites else g.count for g in self.targets
        ]
        n = None if None in counts else sum(c for c in counts if c is not None)
        for sensor in self.sensors:
            target = sensor.pointing.target
            if isinstance(target, int) and n is not None and target >= n:
                raise ValueError(f"sensor {sensor.id} tracks target {target} of {n}")
        return self


def parse_scene(text: str, where: str) -> Scene:
    """Return the scene of a TOML text; `where` names it in messages.

    A table ``[sensor_defaults]`` gives the defaults of every sensor.

    Raises
    ------
    SceneError
        Names the field, the value given and the value expected.
    """
    return validate_scene(scene_values(text, where), where)


def scene_values(text: str, where: str) -> dict[str, Any]:
    """Return the nested mappings of a TOML text, not validated."""
    try:
        return toml_values(text)
    except ValueError as error:
        raise SceneError(f"{where}: not TOML: {error}") from error


def validate_scene(values: dict[str, Any], where: str) -> Scene:
    """Return the scene of nested mappings; see `parse_scene`."""
    defaults = values.pop("sensor_defaults", None) if isinstance(values, dict) else None
    if isinstance(defaults, dict) and isinstance(values.get("sensors"), list):
        values = {**values, "sensors": [_merge(defaults, s) for s in values["sensors"]]}
    try:
        return Scene.model_validate(values)
    except ValidationError as error:
        raise SceneError(f"{where}: {_first_fault(error)}") from error


def _merge(under: Any, over: Any) -> Any:
    if isinstance(under, dict) and isinstance(over, dict):
        shared = {k: _merge(under[k], over[k]) if k in under else over[k] for k in over}
        return {**under, **shared}
    return over


def _first_fault(error: ValidationError) -> str:
    fault = error.errors()[0]
    name = ".".join(str(part) for part in fault["loc"]) or "scene"
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "extra_forbidden":
        return f"unknown field {name}"
    if fault["type"] == "missing":
        return f"{name} is missing"
    if fault["type"] == "value_error":
        return f"{name}: {message}"
    return f"{name} = {fault['input']!r}: {message[0].lower()}{message[1:]}"
