"""The page: whole for every kind of night, safe from names, small, the same each time."""

import base64
import hashlib
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pytest
from scenes.made_nights import filled, hostile_night, reader_of, seconds

from epipole.io.datasets.dataset import night_reader
from epipole.tasks.report.night_facts import read_night_facts

pytest.importorskip("matplotlib")
from epipole.tasks.report import page as page_module
from epipole.tasks.report.draw_sensors import _label_positions
from epipole.tasks.report.page import night_page, report_extract

NIGHT = "2019-04-01"
HOSTILE = [
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "a\nb\r\n\x00\x1b[31m",
    "$x_{1}$ \\frac & % # ' ]]>",
    "s" * 5000,
    "\u202eabc\u4e2d\u6587\U0001f680",
]
EMPTY_TAGS = {"meta", "link", "br"}


class Outline(HTMLParser):
    """The tags of a page, which must be closed in their order, and its pictures."""

    def __init__(self, page):
        super().__init__()
        self.open, self.tags, self.ids, self.places = [], [], [], []
        self.feed(page)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        assert not [name for name, _ in attrs if name.startswith("on")]
        self.ids += [value for name, value in attrs if name == "id"]
        self.places += [value for name, value in attrs if name in ("href", "data-h")]
        if tag not in EMPTY_TAGS:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def page_of(night):
    return night_page(read_night_facts(night, "out"))


def drawings(page):
    Outline(page)
    for picture in re.findall(r'<svg class="plot".*?</svg>', page, re.DOTALL):
        drawing = ElementTree.fromstring(picture)
        assert drawing.get("aria-label")
        yield drawing


@pytest.fixture(scope="module")
def page(night_dataset):
    return page_of(night_reader(night_dataset, NIGHT))


def test_a_run_has_every_section_and_its_pictures(page):
    assert len(list(drawings(page))) >= 12
    assert "Nothing needs a look." in page
    assert "HIP numbers" in page
    for section in ("counts", "coverage", "sigmas", "attitudes", "frame", "image", "sky",
                    "epipolar", "objects", "trend", "logs"):  # fmt: skip
        assert f'<section id="{section}">' in page
        assert f'href="#{section}"' in page


def test_elements_have_their_sigmas_and_positions_the_sigma_of_the_readme(page):
    cells = re.findall(r">20190401-00001</a></td>(.*?)</tr>", page, re.DOTALL)
    row = re.findall(r"<td[^>]*>(.*?)</td>", cells[-1])
    assert 1.0 < float(row[7]) < 1.1
    assert all(re.fullmatch(r"[\d,.]+ ± [\d,.]+", each) for each in row[-3:])


def test_names_of_stars_stay_clear_of_arrows(night_dataset):
    frame = read_night_facts(night_reader(night_dataset, NIGHT), "out").star_map
    size = np.array([500.0, 500.0])
    arrow = np.array([60.0, 0.0])
    frame = frame._replace(
        star_id=frame.star_id[:1], magnitude=frame.magnitude[:1], stars_px=size[None] / 2,
        residuals_px=arrow[None], others_px=np.empty((0, 2)),
    )  # fmt: skip
    assert _label_positions(frame, size, 1.0)[0][2] == "right"
    right = _label_positions(frame._replace(residuals_px=-arrow[None]), size, 1.0)
    assert right[0][2] == "left"


def test_it_needs_no_other_file_and_runs_no_script_but_its_own(page):
    outline = Outline(page)
    assert not {"iframe", "object", "embed", "form", "img", "style"} & set(outline.tags[10:])
    addresses = re.findall(r'(?:href|src)="([^"]{0,20})', page)
    assert {address.partition(":")[0][:1] for address in addresses} <= {"#", "d"}
    assert set(re.findall(r"https?://[^\"' ]*", page)) == {
        "http://www.w3.org/2000/svg",
        "http://www.w3.org/1999/xlink",
    }  # names, not places
    assert_only_its_script(page)


def assert_only_its_script(page):
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in page
    assert page.count("<script") == 1


def test_every_link_leads_to_a_place_of_the_page(page):
    outline = Outline(page)
    places = {place for place in outline.places if not place.startswith("data:")}
    assert {place.removeprefix("#") for place in places} <= set(outline.ids)
    marked = [each for each in outline.ids if not re.match("[mphC][0-9a-f]+|mark", each)]
    assert len(marked) == len(set(marked))
    assert sum(place.startswith("#object-") for place in outline.places) > 20


def test_dots_say_what_they_are(page):
    says = [
        dot for drawing in drawings(page) for each in drawing.iter() if (dot := each.get("data-t"))
    ]
    assert any(re.match(r"star \d+: magnitude", each) for each in says)
    assert any(re.match(r"1, 20190401-00001: seen by sat", each) for each in says)
    assert any("sat1 from 04:00:0" in each and "sigma" in each for each in says)
    assert any(re.match(r"20190401-00001: unknown, sound, 4 sensors", each) for each in says)
    assert sum("frame" in each for each in says) > 1000  # light curves and residuals


def test_axes_say_their_values_for_zoom(page):
    zoomed = [each for each in drawings(page) if each.get("data-box")]
    kinds = [each.get("data-kind") for each in zoomed]
    assert {"number", "ra", "time"} == set(kinds)
    frame = zoomed[kinds.index("number")]
    left, right = map(float, frame.get("data-x").split())
    assert left < 0 < 400 < right < 540
    groups = [each.get("class") for each in frame.iter()]
    assert "data" in groups
    assert groups.count("data marks") >= 3
    assert "xaxis" in groups
    assert "tick" in groups


def test_it_is_small_and_the_same_each_time(page, night_dataset):
    assert len(page.encode()) < 1_000_000
    assert page_of(night_reader(night_dataset, NIGHT)) == page


@pytest.mark.parametrize("name", HOSTILE, ids=range(len(HOSTILE)))
def test_names_from_a_log_are_text(name):
    page = page_of(hostile_night(name))
    assert_only_its_script(page)
    for drawing in drawings(page):
        assert not [each for each in drawing.iter() if each.tag.endswith("script")]
    assert len(page.encode()) < 1_000_000


def nights():
    time, n = seconds(30), 30
    frames = {"sensor_id": ["a"] * n, "time": time}
    yield "empty", reader_of({})
    yield "no stars", reader_of({"frames": filled(
        "frames", **frames, attitude_source=["none"] * n, status=["no_match"] * n)})  # fmt: skip
    yield "one frame", reader_of({"frames": filled(
        "frames", sensor_id=["a"], attitude_source=["stars"])})  # fmt: skip
    yield "no positions", reader_of({
        "frames": filled("frames", **frames, attitude_source=["stars"] * n, n_stars=[4] * n),
        "stars": filled("stars", sensor_id=["a"] * n, time=time, x_px=[9.0] * n, y_px=[9.0] * n),
    })  # fmt: skip


@pytest.mark.parametrize("night", [pytest.param(made, id=name) for name, made in nights()])
def test_sections_without_data_say_so(night):
    page = page_of(night)
    list(drawings(page))
    assert "No object is found." in page
    assert "The dataset has no earlier night." in page
    assert page.count('class="nothing"') >= 4


def test_hundreds_of_sensors_stay_within_a_megabyte():
    sensors = [f"sensor-{k:03}" for k in range(300)]
    n = 20
    frames = filled(
        "frames", sensor_id=sensors * n, time=seconds(n).repeat(len(sensors)),
        attitude_source=["stars"] * (n * len(sensors)), sigma_x_arcsec=[1.0] * (n * len(sensors)),
        sigma_y_arcsec=[1.0] * (n * len(sensors)), sigma_z_arcsec=[1.0] * (n * len(sensors)),
        residual_px=[0.1] * (n * len(sensors)))  # fmt: skip
    page = page_of(reader_of({"frames": frames}))
    assert "16 of 300 sensors" in page
    assert len(page.encode()) < 1_000_000


def test_thousands_of_objects_stay_within_a_megabyte():
    n = 8000
    ids = [f"20190401-{k:05}" for k in range(n)]
    radius_km = np.where(np.arange(n) < n // 2, 42164.0, 7000.0)
    page = page_of(reader_of({
        "objects": filled("objects", object_id=ids, verdict=["sound"] * (n - 1) + ["no_orbit"],
                          n_sensors=[2] * n),
        "orbits": filled("orbits", object_id=ids, x_km=radius_km, a_km=radius_km + np.arange(n),
                         e=[0.001] * n, i_deg=[53.0] * n, sigma_a_km=[1.0] * n),
    }))  # fmt: skip
    assert page.count("Drawn are 500 of 4,000, those that are not sound first.") == 2
    drawn = page[page.index("Semi-major axis, ecc") : page.index("The other objects, by")]
    assert drawn.count(f'data-t="{ids[-1]}: ') == 2  # the one that is not sound, in both axes
    assert len(page.encode()) < 1_000_000


def test_the_extract_is_small_enough_for_an_artifact(night_dataset):
    extract = report_extract(read_night_facts(night_reader(night_dataset, NIGHT), "out"))
    assert len(extract.pictures) == 4
    assert all(picture.png.startswith(b"\x89PNG") for picture in extract.pictures)
    assert sum(len(picture.png) for picture in extract.pictures) * 4 / 3 < 200_000


def test_a_page_that_would_be_too_large_has_fewer_dots(page, night_dataset, monkeypatch):
    monkeypatch.setattr(page_module, "LARGEST_PAGE", len(page.encode()) - 1000)
    smaller = page_of(night_reader(night_dataset, NIGHT))
    assert len(smaller.encode()) < len(page.encode()) - 1000
    assert "One of 4 observations is drawn." in smaller
    assert "One of 4 observations is drawn." not in page
