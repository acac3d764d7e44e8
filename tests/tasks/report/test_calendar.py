"""The calendar: what each night's page says, or its counts; links; nights that cannot be read."""

import re

from epipole.tasks.report.calendar import CalendarNight, calendar_page, judge
from epipole.tasks.report.html import LOOK, WELL


def row(**values):
    usual = {"frames": 1000, "identified": 990, "objects": 9, "positions": 500, "faults": []}
    return {"left_out": 3} | usual | values


def nights(*rows, looks=(), verdict="", address=""):
    return [
        CalendarNight(f"2019-04-{k + 1:02}", each, list(looks), verdict, address)
        for k, each in enumerate(rows)
    ]


def verdicts(found):
    return [each.verdict for each in judge(found)]


def test_a_night_without_a_page_is_judged_by_its_counts():
    rows = [row()] * 5
    assert verdicts(nights(*rows)) == [WELL] * 5
    for odd in (row(identified=500), row(faults=["sat1: clock 3 s late"]), row(objects=0),
                row(positions=100), row(frames=0)):  # fmt: skip
        assert verdicts(nights(*rows, odd)) == [WELL] * 5 + [LOOK]
    assert verdicts(nights(row(), row(positions=100))) == [WELL, WELL]  # too few to compare with
    assert verdicts(nights(row(), None)) == [WELL, ""]


def test_what_a_run_has_recorded_needs_a_look_without_a_page_too():
    (judged,) = judge(nights(row(), looks=["sat1: no frames for 12 s"]))
    assert (judged.verdict, judged.reasons) == (LOOK, ["sat1: no frames for 12 s"])
    assert judged.counted
    (unread,) = judge(nights(None, looks=["sat1: no frames for 12 s"]))
    assert unread.reasons == ["its table `nights` is missing or cannot be read"]


def test_what_the_page_of_a_night_says_counts_more():
    (judged,) = judge(nights(row(identified=10), verdict=WELL))
    assert judged.verdict == WELL
    assert not judged.counted


def test_months_have_their_days_and_nights_their_colour_and_link():
    found = [CalendarNight("2019-03-31", row(), [], LOOK, "reports/2019-03-31.html"),
             CalendarNight("2019-04-01", row(), [], "", "")]  # fmt: skip
    page = calendar_page("out", found)
    assert "March 2019" in page
    assert page.index("April 2019") < page.index("March 2019")
    assert (
        len(re.findall(r'<a class="night bad"[^>]* href="reports/2019-03-31.html">31!</a>', page))
        == 1
    )
    assert '<span class="night good counted"' in page
    assert "1 are well" in page


def test_names_in_a_dataset_are_text():
    page = calendar_page('"><script>x</script>', nights(row(faults=["<b>"]), address='x.html"><i>'))
    assert page.count("<script") == 1
    assert "<b>" not in page
    assert "<i>" not in page
