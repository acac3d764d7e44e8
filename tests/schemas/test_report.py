"""The report of an evaluation, as it is printed."""

from epipole.schemas.report import Report


def test_a_share_is_printed_as_all_only_where_it_is_all():
    printed = [value for _, _, value in Report(star_precision=0.99999, star_recall=1.0).rows()]
    assert printed == ["99.99%", "100.00%"]
