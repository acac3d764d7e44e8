"""Reasons of `rejects`: their sentences say what to correct."""

from epipole.schemas.log_messages import SENSOR_ID_RULE
from epipole.schemas.rejects import Reason


def test_the_sentence_of_a_bad_sensor_id_names_the_rule():
    assert SENSOR_ID_RULE in Reason.BAD_SENSOR_ID.sentence
