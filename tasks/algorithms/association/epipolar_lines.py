"""Association by epipolar lines in pixels: the published method, as a baseline.

Huang, Zhang, Feng: Space target synchronization association method under distributed star
sensor, doi 10.19650/j.cnki.cjsi.J1905157. Points of two images are a pair if one lies within a
fixed distance of the other's epipolar line. All pairs of images are compared, and a table with a
column for each image collects the objects on which all pairs agree. Errors are not used.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.association.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.association.search.seeds import SHORTEST_BASELINE_KM
from epipole.tasks.algorithms.geometry.directions import skew

Pairs = Mapping[tuple[int, int], Indices]

OUTLIER_SIGMA = 3.0  # farthest point from the mean, per axis, in standard deviations
PARALLEL = 1e-14  # squared sine: 0.02 arcsec


def fundamental_matrix(
    M_1: Array, R_1_from_icrs: Array, r_1_km: Array, M_2: Array, R_2_from_icrs: Array, r_2_km: Array
) -> Array:
    """Return F_12 with p_2' F_12 p_1 = 0 for the two images of one point.

    Parameters
    ----------
    M_1, M_2 : (3, 3) float
        Intrinsic matrices [px].
    R_1_from_icrs, R_2_from_icrs : (3, 3) float
        Attitudes of the sensors.
    r_1_km, r_2_km : (3,) float
        Positions of the sensors, GCRF.

    Returns
    -------
    (3, 3) float
        M_2^-T R_12 S M_1^-1, with S the skew matrix of t = r_1 (O_2 - O_1).
    """
    R_2_from_1 = R_2_from_icrs @ R_1_from_icrs.T
    t = R_1_from_icrs @ (r_2_km - r_1_km)
    return np.linalg.inv(M_2).T @ R_2_from_1 @ skew(t) @ np.linalg.inv(M_1)


def line_distances(F_12: Array, p_1_px: Array, p_2_px: Array) -> Array:
    """Return the distance of each second point from each first point's epipolar line.

    Parameters
    ----------
    F_12 : (3, 3) float
        Fundamental matrix.
    p_1_px, p_2_px : (n, 2), (m, 2) float
        Points of the two images [px], distortion removed.

    Returns
    -------
    (n, m) float
        |p_2' F p_1| / sqrt(a^2 + b^2) with (a, b, c) = F p_1 [px].
    """
    lines = np.column_stack([p_1_px, np.ones(len(p_1_px))]) @ F_12.T
    offset = np.abs(lines @ np.column_stack([p_2_px, np.ones(len(p_2_px))]).T)
    return offset / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-300)[:, None]


def pair_points(distance_px: Array, threshold_px: float) -> Indices:
    """Return (k, 2) pairs of points within the threshold, each point at most once.

    The pair with the smallest distance is taken first; ties by the order of the points.
    """
    first, second = np.nonzero(distance_px <= threshold_px)
    order = np.lexsort((second, first, distance_px[first, second]))
    free_1, free_2 = np.ones(len(distance_px), bool), np.ones(distance_px.shape[1], bool)
    out = []
    for i, j in zip(first[order].tolist(), second[order].tolist(), strict=True):
        if free_1[i] and free_2[j]:
            free_1[i] = free_2[j] = False
            out.append((i, j))
    return np.array(sorted(out), np.int64).reshape(-1, 2)


def pair_images(
    images_px: Sequence[Array],
    M: Array,
    R_sensor_from_icrs: Array,
    r_km: Array,
    threshold_px: float,
) -> dict[tuple[int, int], Indices]:
    """Return the pairs of points of every two of s images, the earlier image first.

    Two images from one position have no pairs.

    Parameters
    ----------
    images_px
        Points of each image, (n, 2) [px].
    M, R_sensor_from_icrs, r_km : (s, 3, 3), (s, 3, 3), (s, 3) float
        Intrinsic matrices, attitudes and positions of the sensors.
    threshold_px
        Largest distance of a point from the line (L of the paper).

    Notes
    -----
    The cost grows with the square of the number of images and of points per image.
    """
    out = {}
    for a in range(len(images_px)):
        for b in range(a + 1, len(images_px)):
            # Without a baseline there are no lines: any two points would be a pair.
            if np.linalg.norm(r_km[b] - r_km[a]) < SHORTEST_BASELINE_KM:
                out[a, b] = np.zeros((0, 2), np.int64)
                continue
            F = fundamental_matrix(
                M[a], R_sensor_from_icrs[a], r_km[a], M[b], R_sensor_from_icrs[b], r_km[b]
            )
            out[a, b] = pair_points(line_distances(F, images_px[a], images_px[b]), threshold_px)
    return out


def view_table(n_points: Sequence[int], pairs: Pairs) -> Indices:
    """Return the table of objects: a row for each object, a column for each image.

    A point joins the first row whose points are all paired with it. Otherwise it begins a new
    row. Rows with a single point are dropped.

    Parameters
    ----------
    n_points
        Number of points of each image.
    pairs
        (k, 2) pairs of points of two images (a, b), a < b.

    Returns
    -------
    (rows, images) int
        Index of the object's point in the image, -1 where the image does not show it.
    """
    paired = {key: {(i, j) for i, j in listed.tolist()} for key, listed in pairs.items()}
    rows: list[dict[int, int]] = []
    rows_of: dict[tuple[int, int], list[int]] = {}
    for image, count in enumerate(n_points):
        rows_before: list[set[int]] = [set() for _ in range(count)]
        for earlier in range(image):
            for i, j in pairs.get((earlier, image), np.zeros((0, 2), np.int64)).tolist():
                rows_before[j].update(rows_of[earlier, i])
        for point in range(count):
            for k in sorted(rows_before[point]):
                if image not in rows[k] and all(
                    (member, point) in paired.get((other, image), set())
                    for other, member in rows[k].items()
                ):
                    break
            else:
                k = len(rows)
                rows.append({})
            rows[k][image] = point
            rows_of[image, point] = [k]
    kept = [row for row in rows if len(row) > 1]
    table = np.full((len(kept), len(n_points)), FREE, np.int64)
    for k, row in enumerate(kept):
        table[k, list(row)] = list(row.values())
    return table


def intersect_sights(r_km: Array, u: Array) -> tuple[Array, int]:
    """Return the mean of the points where two lines of sight meet, and the number of points.

    Two lines meet at the middle of their common perpendicular; parallel lines are skipped. A
    point more than 3 standard deviations from the mean in any coordinate is dropped. With fewer
    than 11 points this cannot happen: of m values, the maximum deviation is (m - 1) / sqrt(m).

    Parameters
    ----------
    r_km, u : (n, 3) float
        Positions of the sensors [km] and unit vectors to the object.

    Returns
    -------
    (3,) float, int
        Position [km], NaN where no two lines meet, and the number of points used.
    """
    a, b = np.triu_indices(len(u), 1)
    between, normal = r_km[b] - r_km[a], np.cross(u[a], u[b])
    sine2 = np.sum(normal**2, axis=1)
    meets = sine2 > PARALLEL
    if not meets.any():
        return np.full(3, np.nan), 0
    a, b, between, normal, sine2 = a[meets], b[meets], between[meets], normal[meets], sine2[meets]
    along_a = np.sum(np.cross(between, u[b]) * normal, axis=1) / sine2
    along_b = np.sum(np.cross(between, u[a]) * normal, axis=1) / sine2
    points = (r_km[a] + along_a[:, None] * u[a] + r_km[b] + along_b[:, None] * u[b]) / 2
    off = np.abs(points - points.mean(axis=0))
    kept = (off <= OUTLIER_SIGMA * points.std(axis=0) + 1e-9).all(axis=1)  # 1 mm: rounding
    return points[kept].mean(axis=0), int(kept.sum())


def associate_by_lines(samples: Samples, focal_px: Array, threshold_px: float) -> Groups:
    """Return which tracklets are one object, by the published method at each instant.

    Parameters
    ----------
    samples
        The tracklets at their common instants.
    focal_px : (s,) float
        Focal lengths [px]. Directions become points of distortion-free images centred on 0.
    threshold_px
        Largest distance of a point from the line (L of the paper).

    Returns
    -------
    Groups
        Scores are NaN and no tracklet is ambiguous: the method uses no errors. Two
        tracklets are a pair if they are one at more than half of the instants that show both.
    """
    n_sensors = len(focal_px)
    of_sensor = [np.flatnonzero(samples.sensor == s) for s in range(n_sensors)]
    both: dict[tuple[int, int], Array] = {}
    made: dict[tuple[int, int], Array] = {}
    for m in range(len(samples.time_s)):
        _vote(samples, focal_px, threshold_px, of_sensor, m, made, both)
    pairs = {key: np.argwhere(made[key] * 2 > both[key]) for key in made}
    table = view_table([len(t) for t in of_sensor], pairs)
    group = np.full(len(samples.sensor), FREE, np.int64)
    for s, tracklets in enumerate(of_sensor):
        shown = table[:, s] != FREE
        group[tracklets[table[shown, s]]] = np.flatnonzero(shown)
    nan = np.full(len(samples.half_field), np.nan)
    none = np.zeros(len(group), bool)
    return Groups(group, np.full(len(table), np.nan), none, none, nan)


def _vote(
    samples: Samples,
    focal_px: Array,
    threshold_px: float,
    of_sensor: list[Indices],
    m: int,
    made: dict[tuple[int, int], Array],
    both: dict[tuple[int, int], Array],
) -> None:
    """Count in `made` the pairs of one instant, and in `both` all pairs of its tracklets."""
    R, r = samples.R_sensor_from_icrs[:, m], samples.sensor_km[:, m]
    known = np.flatnonzero(np.isfinite(R).all(axis=(1, 2)) & np.isfinite(r).all(axis=1))
    shown, images = [], []
    for s in known:
        u_sensor = samples.u[of_sensor[s], m] @ R[s].T
        visible = np.flatnonzero(samples.seen[of_sensor[s], m] & (u_sensor[:, 2] > 0))
        shown.append(visible)
        images.append(focal_px[s] * u_sensor[visible, :2] / u_sensor[visible, 2:])
    M = np.zeros((len(known), 3, 3))
    M[:, 0, 0] = M[:, 1, 1] = focal_px[known]
    M[:, 2, 2] = 1.0
    for (a, b), matched in pair_images(images, M, R[known], r[known], threshold_px).items():
        key = int(known[a]), int(known[b])
        for counts in (made, both):
            counts.setdefault(key, np.zeros((len(of_sensor[key[0]]), len(of_sensor[key[1]]))))
        made[key][shown[a][matched[:, 0]], shown[b][matched[:, 1]]] += 1
        both[key][np.ix_(shown[a], shown[b])] += 1
