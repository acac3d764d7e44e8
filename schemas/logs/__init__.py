"""The messages of a log, and the tables that one log gives."""
