"""The command line: the program, its options, and how it stops."""
