"""The work folder of a run: tables on their way from task to task."""
