"""Sections about the sensors: coverage, sigmas, attitudes, the star map, the image."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from epipole.schemas.options import star_ids
from epipole.schemas.rejects import FrameStatus
from epipole.tasks.report.canvas import as_svg
from epipole.tasks.report.draw_sensors import (
    IMAGE_IN,
    MAX_LINES,
    MAX_ROWS,
    coverage_height,
    draw_coverage,
    draw_focal_lengths,
    draw_image_residuals,
    draw_series,
    draw_star_map,
    image_pattern,
    vector_scale,
)
from epipole.tasks.report.draw_sky import draw_chi2, draw_half_normal, draw_normal
from epipole.tasks.report.frame_series import FrameSeries, clock
from epipole.tasks.report.html import (
    Section,
    beside,
    figure,
    figures,
    nothing,
    paragraph,
    table,
)
from epipole.tasks.report.night_facts import NightFacts, duration, holds, percent
from epipole.tasks.report.solved_chi2 import Chi2
from epipole.tasks.report.stars import StarMap, StarResiduals

PICTURE_IN = 2.6  # usual height
FEW_PICTURES = 2  # fill half the width
SERIES_IN = 2.8
MAX_IMAGES = 8  # sensors whose image is drawn
MAX_TABLE_ROWS = 60
MAX_STARS = 16  # as high as the picture beside it


def coverage(facts: NightFacts) -> Section:
    """Return the section about the frames of each sensor over time."""
    series = facts.series
    if series is None:
        return Section("coverage", "Coverage", nothing("The night has no frames."))
    fewer = ""
    if len(series.sensors) > MAX_ROWS:
        fewer = f" Drawn are the {MAX_ROWS} of {len(series.sensors)} sensors with the lowest share."
    picture = figure(
        as_svg(partial(draw_coverage, series=series), coverage_height(series)),
        f"Frames of {len(series.sensors)} sensors over the night; "
        f"{percent(series.counts[0].sum() / series.frames.sum())} are identified by stars.",
        "What became of each sensor's frames over time. In a full strip of one plain "
        "colour every frame was identified; white is a gap, hatched is a frame without stars."
        + fewer,
    )
    tables = _frames_table(series) + _statuses(series) + _gaps(series)
    return Section("coverage", "Coverage", beside(figures([picture]), tables))


def _frames_table(series: FrameSeries) -> str:
    order = np.argsort(series.identified_share, kind="stable")
    if len(order) <= MAX_TABLE_ROWS:
        order = np.arange(len(order))
    by_source = series.counts.sum(axis=2)
    rows = [
        (series.sensors[k], f"{series.frames[k]:,}", percent(series.identified_share[k]),
         f"{by_source[1, k]:,}", f"{by_source[2, k]:,}",
         "" if np.isnan(series.stars[k]) else f"{series.stars[k]:.1f}",
         duration(series.lost_s[k]) if series.lost_s[k] else "none")
        for k in order[:MAX_TABLE_ROWS].tolist()
    ]  # fmt: skip
    caption = "Frames by sensor"
    if len(order) > MAX_TABLE_ROWS:
        caption += f": the {MAX_TABLE_ROWS} of {len(order)} with the lowest share"
    heading = ("sensor", "frames", "identified", "predicted", "no attitude", "stars per frame",
               "gaps")  # fmt: skip
    return table(caption, heading, rows)


def _statuses(series: FrameSeries) -> str:
    if not series.failed:
        return ""
    sentences = {status.value: status.sentence for status in FrameStatus}
    counts = sorted(series.failed.items(), key=lambda item: (-item[1], item[0]))
    rows = [
        (sensor, status, f"{count:,}", sentences.get(status, ""))
        for (sensor, status), count in counts[:MAX_TABLE_ROWS]
    ]
    return table("Why frames are not identified", ("sensor", "status", "frames", "meaning"), rows)


def _gaps(series: FrameSeries) -> str:
    if not series.gaps:
        return paragraph("No sensor has a gap: a time of ten frames or more without frames.")
    longest = sorted(series.gaps, key=lambda gap: -gap.seconds)[:20]
    rows = [
        (gap.sensor_id, clock(gap.start_ns), clock(gap.end_ns), duration(gap.seconds))
        for gap in longest
    ]
    return table("The longest gaps", ("sensor", "from", "to", "length"), rows)


def sigmas(facts: NightFacts) -> Section:
    """Return the section about residuals against what is expected of them."""
    title = "Do the sigmas hold?"
    pictures = list(_sigma_pictures(facts))
    if not pictures:
        return Section("sigmas", title, nothing("The night has no residuals to judge."))
    rows = list(_sigma_rows(facts))
    heading = ("what", "values", "mean square", "verdict")
    body = paragraph("Each residual is divided by its sigma. The mean of the squares should be 1: "
                     "above it the sigmas are too small, below it too large.")  # fmt: skip
    squares = table("Mean squares of normalised residuals", heading, rows)
    few = len(pictures) <= FEW_PICTURES
    body += beside(figures(pictures), squares) if few else figures(pictures) + squares
    return Section("sigmas", title, body)


def _sigma_pictures(facts: NightFacts) -> Iterator[str]:
    residuals, (pairs, positions, states) = facts.residuals, facts.chi2
    if residuals is not None and residuals.counts.sum():
        yield figure(
            as_svg(partial(draw_normal, residuals=residuals), PICTURE_IN),
            f"Histogram of {residuals.counts.sum():,} normalised star residuals and the standard "
            "normal.",
            "Star residuals of all sensors over their sigma. The bars should follow the line. The "
            "sigma is the sensor's usual one, so a log with a sigma per centroid may be a little "
            "narrower or have longer tails.",
        )
    if pairs is not None:
        yield figure(
            as_svg(partial(draw_half_normal, pairs=pairs), PICTURE_IN),
            f"Histogram of {pairs.number:,} distances from epipolar lines and the half normal.",
            "Distances of two views of one object from each other's epipolar line, over their "
            "sigma. The bars should follow the line; long tails are wrong associations.",
        )
    for what, chi2 in (("positions", positions), ("states", states)):
        if chi2 is not None:
            marks = "dots" if len(chi2.few) else "bars"
            last = "" if len(chi2.few) else " The last bar has all above it."
            yield figure(
                as_svg(partial(draw_chi2, found=chi2, what=what), PICTURE_IN),
                f"The chi-squares of {chi2.number:,} {what} and their distribution.",
                f"Chi-squares of {what}. The {marks} should follow the line. If they are more to "
                f"the right: sigmas too small, or a sensor that is off.{last}",
            )


def _sigma_rows(facts: NightFacts) -> Iterator[tuple[str, str, str, str]]:
    if facts.residuals is not None:
        stars = facts.residuals
        order = np.argsort(
            -np.abs(np.log(np.nan_to_num(stars.mean_square, nan=1.0))), kind="stable"
        )
        shown = sorted(order[:MAX_TABLE_ROWS].tolist())
        for k in shown:
            if np.isfinite(stars.mean_square[k]):
                yield (f"star residuals of {stars.sensors[k]}", f"{2 * stars.stars[k]:,}",
                       f"{stars.mean_square[k]:.2f}", _verdict(stars.mean_square[k]))  # fmt: skip
    for what, chi2 in zip(("pair distances", "positions", "states"), facts.chi2, strict=True):
        if isinstance(chi2, Chi2):
            yield what, f"{chi2.number:,}", f"{chi2.mean:.2f}", _verdict(chi2.mean)


def _verdict(mean_square: float) -> str:
    if holds(mean_square):
        return "holds"
    return "sigma too small" if mean_square > 1 else "sigma too large"


def attitudes(facts: NightFacts) -> Section:
    """Return the section about attitude sigmas, star residuals and focal lengths."""
    title = "Attitudes and optics"
    series = facts.series
    if series is None:
        return Section("attitudes", title, nothing("The night has no attitudes."))
    pictures = [
        figure(as_svg(partial(draw_series, series=series, what=what, ylabel=label), SERIES_IN),
               f"{about} of each sensor over the night.", f"{about}. {well}")
        for what, label, about, well in (
            ("across", "sigma across [arcsec]", "Attitude sigma across the boresight (rms)",
             "It should be level; a rise means fewer stars, or only a prior attitude."),
            ("about", "sigma about boresight [arcsec]", "Attitude sigma about the boresight (rms)",
             "It should be level. It is many times larger than across, the more so the narrower "
             "the field."),
            ("residual", "star residual [px]", "Star residual (rms)",
             "It should be level and near the sigma of a centroid; a rise means blur, stray "
             "light or changed optics."),
        )
        if np.isfinite(series.rms[what]).any()
    ]  # fmt: skip
    if len(series.sensors) > MAX_LINES:
        some = f"Drawn are {MAX_LINES} of {len(series.sensors)} sensors, the largest residuals."
        pictures.append(paragraph(some))
    pictures += _focal_lengths(facts)
    body = figures(pictures) if pictures else nothing("No frame has an attitude.")
    return Section("attitudes", title, body + _optics_table(facts))


def _focal_lengths(facts: NightFacts) -> list[str]:
    nights = [each for each in facts.trend if each.focal_px]
    names = sorted(facts.trend[-1].focal_px)[:MAX_LINES]
    if len(nights) < 2 or not names:
        return []
    ppm = {}
    for name in names:
        values = np.array([each.focal_px.get(name, np.nan) for each in nights])
        ppm[name] = 1e6 * (values / np.nanmedian(values) - 1)
    dates = [each.night for each in nights]
    draw = partial(draw_focal_lengths, nights=dates, ppm=ppm)
    return [figure(as_svg(draw, SERIES_IN),
                   f"Focal lengths of {len(names)} sensors over {len(nights)} nights.",
                   "Fitted focal length of each night, in millionths from the sensor's median. It "
                   "should scatter about 0; a drift is heat, a step is a shock.")]  # fmt: skip


def _optics_table(facts: NightFacts) -> str:
    rows = [
        (row["sensor_id"], f"{abs(row['fx_px'] * row['fy_px']) ** 0.5:.2f}",
         f"{min(row['sigma_fx_px'], row['sigma_fy_px']):.2f}",
         f"{row['residual_px']:.3f}", f"{row['n_stars']:,}")
        for row in facts.calibrations.head(MAX_TABLE_ROWS).to_dicts()
    ]  # fmt: skip
    if not rows:
        return nothing("No optics were fitted this night.")
    heading = ("sensor", "focal length px", "sigma px", "residual px", "star images used")
    return table("Optics fitted to the stars of the night", heading, rows)


def star_map(facts: NightFacts) -> Section:
    """Return the section with one frame as a map."""
    title, frame = "One frame", facts.star_map
    if frame is None:
        identified = facts.series is not None and facts.series.counts[0].any()
        why = "The table `stars` has no frame to draw." if identified else "No frame is identified."
        return Section("frame", title, nothing(why) + _concerned(facts))
    size = facts.size_px(frame.sensor_id)
    scale = vector_scale(frame.residuals_px, size)
    ids = star_ids(facts.star_catalogue)
    names = f"{ids} numbers" if ids else "numbers in the catalogue"
    picture = figure(
        as_svg(partial(draw_star_map, frame=frame, size_px=size), IMAGE_IN),
        f"Star map of frame {frame.frame_number} of {frame.sensor_id}: {len(frame.star_id)} stars, "
        f"{len(frame.others_px)} other detections.",
        f"Frame {frame.frame_number} of {frame.sensor_id} at {clock(frame.time_ns)} UTC, with a "
        f"usual number of stars, which have {names}. Arrows are star residuals, drawn {scale:,.0f} "
        "times longer. They should point in all directions; a pattern is an error of the optics.",
    )
    body = beside(figures([picture]), _stars_table(frame, ids))
    return Section("frame", title, body + _concerned(facts))


def _concerned(facts: NightFacts) -> str:
    """Return the frames of sensors that need a look."""
    if not facts.concerned:
        return ""
    pictures = []
    for number, frame in enumerate(facts.concerned.values(), start=1):
        size = facts.size_px(frame.sensor_id)
        why = f"not identified: {frame.status}" if frame.status else "its star residual is large"
        pictures.append(figure(
            as_svg(partial(draw_star_map, frame=frame, size_px=size), IMAGE_IN),
            f"Frame {frame.frame_number} of {frame.sensor_id}: {len(frame.star_id)} stars, "
            f"{len(frame.others_px)} other detections.",
            f"Frame {frame.frame_number} of {frame.sensor_id} at {clock(frame.time_ns)} UTC, "
            f"{why}. It is of the time with most such frames.",
            f"frame-{number}",
        ))  # fmt: skip
    return "<h3>Frames of sensors that need a look</h3>\n" + figures(pictures)


def _stars_table(frame: StarMap, ids: str) -> str:
    order = np.argsort(frame.magnitude, kind="stable")[:MAX_STARS]
    rows = [
        (str(frame.star_id[k]), f"{frame.magnitude[k]:.1f}",
         *(f"{value:.1f}" for value in frame.stars_px[k]),
         *(f"{value:.3f}" for value in frame.residuals_px[k]))
        for k in order.tolist()
    ]  # fmt: skip
    caption = "Its stars" + (
        f", the brightest {MAX_STARS}" if len(frame.star_id) > len(rows) else ""
    )
    heading = (ids or "star", "magnitude", "column px", "row px", "residual columns",
               "residual rows")  # fmt: skip
    return table(caption, heading, rows)


def image_residuals(facts: NightFacts) -> Section:
    """Return the section about residuals over the image."""
    title, residuals = "Residuals over the image", facts.residuals
    if residuals is None:
        return Section("image", title, nothing("The table `stars` is empty."))
    pictures = [_image_picture(residuals, k) for k in _most_patterned(residuals)]
    how = (
        "Mean star residual in each part of the image. Arrows should point in all directions, and "
        "few should be more than chance explains; a swirl, or all outwards, is an error of the "
        "optics. One star that stays in a part shows the error of its catalogue position."
    )
    some = ""
    if len(pictures) < len(residuals.sensors):
        some = f" Drawn are {len(pictures)} of {len(residuals.sensors)} sensors, the largest means."
    return Section("image", title, paragraph(how + some) + figures(pictures))


def _most_patterned(residuals: StarResiduals) -> list[int]:
    """Return the sensors to draw: those with the most means that are more than chance."""
    found = [int(image_pattern(residuals, k)[1].sum()) for k in range(len(residuals.sensors))]
    worst = sorted(range(len(found)), key=lambda k: -found[k])[:MAX_IMAGES]
    return sorted(k for k in worst if residuals.stars[k])


def _image_picture(residuals: StarResiduals, k: int) -> str:
    mean, surely = image_pattern(residuals, k)
    scale = vector_scale(mean[np.isfinite(mean[:, 0])], residuals.size_px[k])
    name = residuals.sensors[k]
    return figure(
        as_svg(partial(draw_image_residuals, residuals=residuals, k=k), IMAGE_IN - 0.2),
        f"Mean star residual over the image of {name}, {residuals.stars[k]:,} stars.",
        f"{name}: {surely.sum()} of {np.isfinite(mean[:, 0]).sum()} parts are more than chance. "
        f"Arrows are drawn {scale:,.0f} times longer.",
    )
