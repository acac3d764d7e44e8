"""The files of the simulator: scenes, star catalogues and the truth of a log."""
