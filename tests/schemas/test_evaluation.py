"""The report of an evaluation, as it is printed."""

import itertools
from dataclasses import fields

from epipole.schemas.evaluation import Report


def test_a_share_is_printed_as_all_only_where_it_is_all():
    printed = [value for _, _, value in Report(star_precision=0.99999, star_recall=1.0).rows()]
    assert printed == ["99.99%", "100.00%"]


def test_every_measure_has_a_definition_of_its_own():
    definitions = [f.metadata["definition"] for f in fields(Report)]
    assert len(set(definitions)) == len(definitions) > 40
    assert all(not text[0].islower() and text.endswith(".") for text in definitions)


def test_measures_of_a_group_are_printed_together_and_none_is_skipped():
    groups = [group for group, _, _ in Report(**{f.name: 1 for f in fields(Report)}).rows()]
    assert len(groups) == len(fields(Report))
    starts = [b for a, b in itertools.pairwise(["", *groups]) if a != b]
    assert len(starts) == len(set(starts))
    assert Report().rows() == []
