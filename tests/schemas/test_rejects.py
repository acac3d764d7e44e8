"""Reasons of `rejects`: their sentences say what to correct."""

from epipole.schemas.log_messages import SENSOR_ID_RULE
from epipole.schemas.rejects import Reason, Trait
from epipole.schemas.stages import Stage


def test_the_sentence_of_a_bad_sensor_id_names_the_rule():
    assert SENSOR_ID_RULE in Reason.BAD_SENSOR_ID.sentence


def test_traits_are_of_the_reasons_that_messages_list():
    """Traits decide what is an alert, an invalid calibration or a sum: not by a list elsewhere."""
    assert {r.stage for r in Reason.having(Trait.INVALID_CALIBRATION)} == {Stage.READ}
    of_check = {reason for reason in Reason if reason.stage is Stage.CHECK}
    assert set(Reason.having(Trait.SENSOR_FAULT)) == of_check | {Reason.SENSOR_DISAGREES}
    assert not Reason.TRUNCATED.traits
