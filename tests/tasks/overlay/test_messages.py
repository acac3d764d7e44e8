"""Messages of an overlay that need no run: lines of log."""

from foxglove_schemas_protobuf.Log_pb2 import Log
from scenes.made_nights import filled

from epipole.schemas.bridge import to_polars
from epipole.tasks.overlay.messages import log_messages


def test_a_reason_of_another_version_is_a_line_too():
    rejects = filled(
        "rejects", source=["a.mcap"], stage=["read"], reason=["of_tomorrow"], count=[2]
    )
    (line,) = log_messages(to_polars(rejects))
    says = Log.FromString(line.data).message
    assert says == "a.mcap: A reason of another version of the program. (2)"
