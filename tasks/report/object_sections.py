"""Sections about what was found: tracklets, the globe, epipolar lines, objects, the last nights."""

from collections.abc import Mapping, Sequence
from functools import partial

from epipole.schemas.rejects import NameStatus, ObjectVerdict, Outcome
from epipole.tasks.report.canvas import as_svg
from epipole.tasks.report.draw_globe import draw_globe
from epipole.tasks.report.draw_sensors import IMAGE_IN, draw_epipolar
from epipole.tasks.report.draw_sky import draw_elements, draw_ring, draw_sky, draw_trend
from epipole.tasks.report.frame_series import clock
from epipole.tasks.report.html import (
    Link,
    Section,
    beside,
    figure,
    figures,
    nothing,
    paragraph,
    table,
    with_sigma,
)
from epipole.tasks.report.night_facts import NightFacts, look_first, percent
from epipole.tasks.report.object_parts import detailed
from epipole.tasks.report.objects import NightObject

MAX_OBJECTS = 100
MAX_DRAWN = 500  # in a picture: each has a mark and a text
PICTURE_IN = 2.8


def sky(facts: NightFacts) -> Section:
    """Return the section about tracklets on the sky."""
    title, tracks = "Tracklets on the sky", facts.tracks
    if tracks is None or not tracks.lines:
        return Section("sky", title, nothing("The night has no tracklets."))
    total = sum(tracks.counts.values())
    some = f" Drawn are {len(tracks.lines):,} of {total:,}." if len(tracks.lines) < total else ""
    picture = figure(
        as_svg(partial(draw_sky, tracks=tracks, anchors=facts.anchors), 3.2),
        f"{total:,} tracklets in right ascension and declination, by what became of them.",
        "Tracklets of all sensors; the marker is at the end. Each sensor sees an object in another "
        "direction. Most should belong to an object where sensors look at the same region." + some,
    )
    sentences = {outcome.value: outcome.sentence.replace("`", "") for outcome in Outcome}
    rows = [(name, f"{count:,}", sentences[name]) for name, count in tracks.counts.items()]
    heading = ("outcome", "tracklets", "meaning")
    body = beside(figures([picture]), table("What became of the tracklets", heading, rows))
    return Section("sky", title, body)


def globe(facts: NightFacts) -> Section:
    """Return the section with the globe: sensors, objects and lines of sight at one time."""
    title, found = "Sensors and objects in space", facts.globe
    if found is None:
        return Section("globe", title, nothing("The log says of no sensor where it was."))
    about = {each.object_id: each.about for each in facts.objects}
    to_objects = sum(bool(sight.object_id) for sight in found.sights)
    picture = figure(
        draw_globe(found, about, facts.anchors),
        f"{len(found.sensors)} sensors, {len(found.objects)} objects and {len(found.sights)} lines "
        "of sight around the Earth.",
        f"At {clock(found.time_ns)} UTC, in the axes of GCRF, the north pole above: sensors "
        "(triangles), objects (dots), and who saw what. Drag to turn it.",
    )
    rows = [
        ("sensors", f"{found.n_sensors:,}", f"{len(found.sensors):,}"),
        ("objects", f"{found.n_objects:,}", f"{len(found.objects):,}"),
        ("lines of sight", f"{found.n_sights:,}", f"{len(found.sights):,}"),
        ("of these to objects", "", f"{to_objects:,}"),
    ]
    says = (
        "A grey, dashed line is of a tracklet that belongs to no object: its length says nothing."
    )
    counts = table("At this time", ("what", "there are", "drawn"), rows)
    return Section("globe", title, beside(figures([picture]), counts + paragraph(says)))


def epipolar(facts: NightFacts) -> Section:
    """Return the section with the epipolar lines of one epoch."""
    title, views = "Epipolar lines", facts.epipolar
    if views is None:
        sentence = "No object was seen by two sensors whose optics were fitted."
        return Section("epipolar", title, nothing(sentence))
    farthest = max((line.distance_px for line in views.lines), default=0.0)
    picture = figure(
        as_svg(partial(draw_epipolar, views=views, anchors=facts.anchors), IMAGE_IN),
        f"Image of {views.in_sensor} with {len(views.lines)} lines of sight of "
        f"{views.from_sensor}.",
        f"What {views.from_sensor} sees at {clock(views.epoch_ns)} UTC is a line in the image of "
        f"{views.in_sensor}. Each ring should lie on the line of its number; the farthest is "
        f"{farthest:.2f} px away. Where all is well it is as far as the pair distances above say.",
    )
    rows = [
        (str(number), _link(line.object_id, facts.anchors), f"{line.distance_px:.2f}")
        for number, line in enumerate(views.lines, start=1)
    ]
    distances = table("Distance of rings from lines", ("number", "object", "px"), rows)
    return Section("epipolar", title, beside(figures([picture]), distances))


def objects(facts: NightFacts) -> Section:
    """Return the section about the objects."""
    title, found = "Objects", facts.objects
    if not found:
        return Section("objects", title, nothing("No object is found."))
    ring = [each for each in found if each.near_geostationary]
    others = [each for each in found if each.has_orbit and not each.near_geostationary]
    pictures = []
    if ring:
        drawn, some = _drawn(ring)
        pictures.append(figure(
            as_svg(partial(draw_ring, objects=drawn, anchors=facts.anchors), PICTURE_IN),
            f"Longitude and latitude of {len(drawn)} objects near the geostationary ring.",
            "Objects near the geostationary ring: from their first to their last position, which "
            f"has the marker. A station-kept one hardly moves.{some}",
        ))  # fmt: skip
    if others:
        drawn, some = _drawn(others)
        pictures.append(figure(
            as_svg(partial(draw_elements, objects=drawn, anchors=facts.anchors), 3.6),
            f"Semi-major axis, eccentricity and inclination of {len(drawn)} objects.",
            "The other objects, by their orbits, with bars of one sigma. From a short arc, axis "
            f"and eccentricity are uncertain: their scatter is not that of orbits.{some}",
        ))  # fmt: skip
    body = beside(figures(pictures), paragraph(_names(found)) + _verdicts(found))
    body += _table(found, facts.anchors) + detailed(facts)
    return Section("objects", title, body)


def _drawn(found: Sequence[NightObject]) -> tuple[list[NightObject], str]:
    """Return the objects of a picture in the order of their ids, and a sentence if not all."""
    if len(found) <= MAX_DRAWN:
        return list(found), ""
    drawn = sorted(look_first(found, MAX_DRAWN), key=lambda each: each.object_id)
    return drawn, f" Drawn are {len(drawn)} of {len(found):,}, those that are not sound first."


def _names(found: Sequence[NightObject]) -> str:
    counts = {status: sum(each.status == status for each in found) for status in NameStatus}
    listed = ", ".join(f"{count:,} {status}" for status, count in counts.items() if count)
    linked = sum(not each.positions for each in found)
    alone = f" {linked:,} have no positions: orbits join their tracklets." if linked else ""
    return f"{len(found):,} objects: {listed}.{alone}"


def _verdicts(found: Sequence[NightObject]) -> str:
    """Return how many objects are sound, and how many are not and why."""
    rows = [
        (verdict.value, f"{count:,}", verdict.sentence)
        for verdict in reversed(ObjectVerdict)
        if (count := sum(each.verdict == verdict for each in found))
    ]
    return table("What is to be thought of them", ("verdict", "objects", "meaning"), rows)


def _table(found: Sequence[NightObject], anchors: Mapping[str, str]) -> str:
    order = sorted(found, key=lambda each: (each.status == NameStatus.KNOWN, -each.positions))
    shown = order[:MAX_OBJECTS]
    rows = [
        (_link(each.object_id, anchors), each.status, each.name, each.verdict,
         f"{each.positions:,}", clock(each.first_ns), clock(each.last_ns), str(each.sensors),
         _number(each.sigma_km), *_geography(each))
        for each in shown
    ]  # fmt: skip
    caption = "Objects; unknown ones first"
    if len(found) > len(shown):
        caption += f", {len(shown)} of {len(found):,}"
    heading = ("object", "status", "name", "verdict", "positions", "from", "to", "sensors",
               "sigma km", "radius km", "longitude", "latitude", "a km", "e", "i deg")  # fmt: skip
    return table(caption, heading, rows)


def _link(object_id: str, anchors: Mapping[str, str]) -> Link | str:
    anchor = anchors.get(object_id)
    return Link(object_id, anchor[1:]) if anchor else object_id


def _number(value: float) -> str:
    return f"{value:.3g}" if value == value else ""


def _geography(each: NightObject) -> tuple[str, ...]:
    if each.ends is None:
        return ("",) * 6
    longitude, latitude, radius = each.ends[1]
    geography = f"{radius:,.0f}", f"{longitude:.2f}", f"{latitude:.2f}"
    if each.elements is None:
        return (*geography, "", "", "")
    return *geography, *map(with_sigma, each.elements, each.element_sigmas)


def trend(facts: NightFacts) -> Section:
    """Return the section about the last nights of the dataset."""
    title, nights = "The last nights", facts.trend
    if len(nights) < 2:
        return Section("trend", title, nothing("The dataset has no earlier night."))
    picture = figure(
        as_svg(partial(draw_trend, nights=nights), 4.2),
        f"Frames, share identified, objects, positions and rejects of {len(nights)} nights.",
        "Numbers of the last nights; the large marker is this night. Steps that the sensors' "
        "programme does not explain need a look.",
    )
    rows = [
        (each.night, f"{each.frames:,}", percent(each.identified_share), f"{each.objects:,}",
         f"{each.positions:,}", f"{each.rejects:,}")
        for each in reversed(nights)
    ]  # fmt: skip
    heading = ("night", "frames", "identified", "objects", "positions", "left out")
    return Section("trend", title, figures([picture]) + table("Nights", heading, rows))
