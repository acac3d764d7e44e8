"""`epipole info`: what is in logs."""

from epipole.flows.command_line.options import AsJson, Logs
from epipole.flows.command_line.printing import print_json, print_lines


def info(logs: Logs, as_json: AsJson = False) -> None:
    """Show what is in logs: sensors, times, counts, and what cannot be used."""
    from epipole.flows.command_line.log_info import describe, lines
    from epipole.io.logs.listing import list_logs

    described = [describe(log) for where in logs for log in list_logs(where)[0]]
    if as_json:
        print_json(described)
    else:
        print_lines(line for log in described for line in lines(log))
