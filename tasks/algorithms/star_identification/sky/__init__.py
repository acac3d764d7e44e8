"""The sky as one camera needs it: stars to a limit, their grid and their pairs."""
