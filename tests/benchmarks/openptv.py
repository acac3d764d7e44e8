"""OpenPTV's correspondences on the benchmark's points (`optv`, with the group ``bench``).

OpenPTV has the objects about the origin and the cameras at +z: a rotation about the middle of the
scene gives that. Its cameras look along -z with y up. Its "glass" gets the refractive index of
both sides. With these the images agree to 1e-11 px. It takes at most 4 cameras.
"""

import numpy as np
from optv.calibration import Calibration
from optv.correspondences import MatchedCoords, correspondences
from optv.parameters import ControlParams, VolumeParams
from optv.tracking_framebuf import TargetArray
from points import CENTRE_KM, PIXEL_RAD

from epipole.tasks.algorithms.association.samples import FREE, Samples
from epipole.tasks.algorithms.geometry.directions import tangent_basis

PIXELS = 512
SPAN_KM = 1000.0  # half the width of the volume
DEPTH_KM = 100.0  # half its depth: the altitudes of the objects are known
GLASS_KM = 20000.0  # anywhere between objects and cameras


def _angles(R: np.ndarray) -> np.ndarray:
    """Return OpenPTV's angles about x, y and z of the matrix whose columns are a camera's axes."""
    return np.array(
        [np.arctan2(-R[1, 2], R[2, 2]), np.arcsin(R[0, 2]), np.arctan2(-R[0, 1], R[0, 0])]
    )


def _control() -> ControlParams:
    control = ControlParams(4)
    control.set_image_size((PIXELS, PIXELS))
    control.set_pixel_size((PIXEL_RAD, PIXEL_RAD))  # the focal length is 1
    glass = control.get_multimedia_params()
    glass.set_n1(1.0)
    glass.set_layers([1.0], [1.0])
    glass.set_n3(1.0)
    return control


def cameras(samples: Samples) -> list[Calibration]:
    """Return the sensors as OpenPTV's cameras."""
    r = samples.sensor_km[:, 0]
    normal = (r - CENTRE_KM).mean(axis=0)
    normal /= np.linalg.norm(normal)
    world = np.vstack([tangent_basis(normal), normal])
    out = []
    for k, R in enumerate(samples.R_sensor_from_icrs[:, 0]):
        axes = np.stack([R[0], -R[1], -R[2]]) @ world.T
        out.append(
            Calibration(
                pos=world @ (r[k] - CENTRE_KM),
                angs=_angles(axes.T),
                prim_point=np.array([0.0, 0.0, 1.0]),
                rad_dist=np.zeros(3),
                decent=np.zeros(2),
                affine=np.array([1.0, 0.0]),
                glass=np.array([0.0, 0.0, GLASS_KM]),
            )
        )
    return out


def associate_by_openptv(samples: Samples, eps_px: float) -> np.ndarray:
    """Return OpenPTV's groups of four sensors' points: in all four sensors, or in three."""
    control = _control()
    volume = VolumeParams(
        x_span=np.array([-SPAN_KM, SPAN_KM]),
        z_spans=[np.array([-DEPTH_KM, DEPTH_KM])] * 2,
        pixels_tot=0.0,
        pixels_x=0.0,
        pixels_y=0.0,
        ref_gray=0.0,
        epipolar_band=eps_px * PIXEL_RAD,
        min_correlation=0.0,
    )
    calibrations = cameras(samples)
    own, targets, flat = [], [], []
    for k, R in enumerate(samples.R_sensor_from_icrs[:, 0]):
        mine = np.flatnonzero(samples.sensor == k)
        toward = samples.u[mine, 0] @ R.T
        place = toward[:, :2] / toward[:, 2:] / PIXEL_RAD + PIXELS / 2
        mine, place = mine[np.argsort(place[:, 1])], place[np.argsort(place[:, 1])]
        array = TargetArray(len(mine))
        for n in range(len(mine)):
            array[n].set_pnr(n)
            array[n].set_pos(tuple(place[n]))
            array[n].set_pixel_counts(9, 3, 3)
            array[n].set_sum_grey_value(100)
            array[n].set_tnr(-1)
        own.append(mine)
        targets.append(array)
        flat.append(MatchedCoords(array, control, calibrations[k]))
    _, found, _ = correspondences(targets, flat, calibrations, volume, control)
    group, count = np.full(len(samples.sensor), FREE), 0
    for members in found[:2]:
        for row in np.asarray(members).T:
            for k in range(4):
                if row[k] >= 0:
                    group[own[k][row[k]]] = count
            count += 1
    return group
